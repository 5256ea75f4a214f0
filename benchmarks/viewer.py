"""How quick is the viewer? Headless Chromium with software WebGL: the first picture, changes, orbiting.

    python benchmarks/viewer.py FIELD COLOR [--scene SCENE] [--size 800x600] [--turns 10] [--chromium /usr/bin/chromium]

"First picture": from starting `kfgs view` to a picture that is read back (a coarse one, then the full one), browser started
before; from nothing, and with the scene that the first start kept.

A change is timed in the page until its picture is read back: the quick one that a person sees first, and the full one.
Frames per second while the camera turns are of quick pictures, too.
"""

from __future__ import annotations

import argparse
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

SOFTWARE = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
CHANGES = {
    "mode": "v.setMode(turn % 2 ? 'labels' : 'color')",
    "lambda": "m.setLambda(lambda * (1 + 0.1 * (turn % 2)))",
    "hidden class": "m.toggleHidden(0)",
    "query (answered by Python)": "await v.ask(words[turn % words.length])",
    "gamma": "m.setGamma(0.4 + 0.02 * turn, true)",
    "undo": "m.undo()",
}
TIME = """async ([change, turns]) => {
  const v = document.querySelector(".kfgs").viewer, m = v.model, lambda = m.lambda;
  const words = m.names.filter((_, label) => m.own.includes(label)).slice(0, 6);
  const run = new Function("v", "m", "turn", "words", "lambda", `return (async () => {${change}})()`);
  const drawn = (moving) => { v.panes.moving = moving; v.panes.draw(); wait(v); };
  const quick = [], full = [];
  for (let turn = 0; turn < turns; turn++) {
    let began = performance.now();
    await run(v, m, turn, words, lambda);
    drawn(true);
    quick.push(performance.now() - began);
    began = performance.now();
    drawn(false);
    full.push(performance.now() - began);
  }
  return [quick, full];
}"""
FIRST = """globalThis.wait = ({panes: {renderer: {gl}}}) =>
  gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
addEventListener("DOMContentLoaded", () => new MutationObserver((_, watcher) => {
  const root = document.querySelector(".kfgs:not([aria-busy])");
  if (!root?.viewer?.eye) return;
  watcher.disconnect();
  wait(root.viewer);
  globalThis.first = Date.now();
}).observe(document, {attributes: true, subtree: true, attributeFilter: ["aria-busy"]}))"""
FULL = """async () => {
  while (!globalThis.first) await new Promise((resolve) => setTimeout(resolve, 20));
  const v = document.querySelector(".kfgs").viewer;
  while (v.panes.moving) await new Promise(requestAnimationFrame);
  wait(v);
  return [first / 1000, Date.now() / 1000];
}"""
TURN = """async (frames) => {
  const v = document.querySelector(".kfgs").viewer;
  const began = performance.now();
  for (let i = 0; i < frames; i++) {
    v.eye.orbit(6, 1);
    v.panes.forgetCamera();
    v.panes.moving = true;
    v.panes.draw();
    wait(v);
    await new Promise((resolve) => setTimeout(resolve));
  }
  return (1000 * frames) / (performance.now() - began);
}"""


def main() -> None:
    """Print a table."""
    from playwright.sync_api import sync_playwright

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("field", type=Path)
    parser.add_argument("color", type=Path)
    parser.add_argument("--scene", type=Path)
    parser.add_argument("--size", default="800x600")
    parser.add_argument("--turns", type=int, default=10)
    parser.add_argument("--chromium", default="/usr/bin/chromium")
    args = parser.parse_args()
    width, height = map(int, args.size.split("x"))
    command = [sys.executable, "-m", "kfgs", "view", str(args.field), "--color", str(args.color), "--where", "browser"]
    command += ["--scene", str(args.scene)] if args.scene else []
    with sync_playwright() as playwright, tempfile.TemporaryDirectory() as kept:
        browser = playwright.chromium.launch(executable_path=args.chromium, args=SOFTWARE)
        for start in ("from nothing", "the second time"):
            page = browser.new_page(viewport={"width": width, "height": height})
            with opened(page, command, kept) as (first, full):
                print(f"first picture {start}: {first:.1f} s, in full {full:.1f} s")
                if start != "from nothing":
                    changes(page, args.turns)
        browser.close()


@contextmanager
def opened(page: Any, command: list[str], kept: str) -> Iterator[tuple[float, float]]:
    """The page that a command serves, once Python has loaded; yields the seconds to the first picture, and to the full one."""
    page.set_default_timeout(300_000)
    page.add_init_script(FIRST)
    began = time.time()
    caches = os.environ | {"XDG_CACHE_HOME": kept}
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=caches) as served:
        assert served.stdout is not None
        said = next(line for line in served.stdout if "http://" in line)
        page.goto(re.search(r"http://\S+", said)[0])  # type: ignore[index]
        first, full = page.evaluate(FULL)
        page.evaluate("fetch('version')")
        time.sleep(2)  # the scene is kept, or the page loads an outdated one again
        yield first - began, full - began
        served.terminate()
        page.close()


def changes(page: Any, turns: int) -> None:
    """Print how long changes take, and frames per second."""
    print("| change | quick picture, ms | full picture, ms |\n|---|---|---|")
    for name, change in CHANGES.items():
        quick, full = page.evaluate(TIME, [change, turns])
        print(f"| {name} | {statistics.median(quick):.0f} | {statistics.median(full):.0f} |")
    frames = page.evaluate(TURN, turns)
    page.evaluate("document.querySelector('.kfgs').viewer.model.ask(null)")
    print(f"\n{frames:.1f} frames a second while turning with a selection, {page.evaluate(TURN, turns):.1f} without")


if __name__ == "__main__":
    main()
