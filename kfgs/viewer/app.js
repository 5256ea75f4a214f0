/** The viewer's interface: `mount` puts it into an element. Data come from a pack, answers from a link. */

import { TOOLS, makeCaptions, makeHelp, makePhoto, makeRail, makeTop, makeViews } from "./chrome.js";
import { download, h, svg } from "./dom.js";
import { Eye, ahead, between, viewOf } from "./eye.js";
import { marksIn } from "./marks.js";
import { Model, short } from "./model.js";
import { makePanel } from "./panel.js";
import { Panes } from "./panes.js";
import { Tools } from "./tools.js";

const MODES = { color: "Colour", labels: "Classes", score: "Score", latents: "Latents" };
const BACKGROUND = { light: [0.957, 0.961, 0.969], dark: [0.094, 0.102, 0.118] };
const ROLL = Math.PI / 36; // radians
const GLIDE = 350; // milliseconds of a move to another view
const SAID = 9000; // milliseconds that a message stays
const MOST_BYTES = 2 ** 29 - 2 ** 16; // of a file to open: LONGEST_FILE of server.py with what is sent with it
const BRUSH = [6, 120]; // pixels: smallest and largest radius
const NARROW = { narrow: 900, slim: 640, thin: 480 }; // CSS pixels of the width
const LOW = 420; // of the height
const ASIDE = 1; // how far beside the originals copies appear, of their radius

/**
 * Show a scene in an element.
 * @param {HTMLElement} root filled; the page gives it a size
 * @param {{header: object, data: ArrayBuffer}} packed see kfgs/viewer/pack.py
 * @param {object} link see link.js
 * @returns {Promise<App>} has `model`, `panes`, `eye`, `ask(words)`, `settled()`, `dispose()`
 */
export async function mount(root, packed, link) {
  const app = (root.viewer = new App(root, packed, link));
  try {
    await app.start();
  } catch (error) {
    app.fail(error.message);
    throw error;
  }
  return app;
}

class App {
  constructor(root, packed, link) {
    Object.assign(this, { root, packed, link, header: packed.header, model: new Model(packed) });
    this.modes = possibleModes(packed.header);
    this.through = false; // whether tools select what others hide, too
    this.photo = null; // number of the view whose photo is shown
    this.view = null; // number of the view that the camera is at
    this.urls = new Map();
    this.marks = []; // {name, places}, that Python added
    this.ondraw = () => {}; // after each picture
    this.build();
  }

  build() {
    const { root, model } = this;
    this.canvas = h("canvas", { role: "img", "aria-label": `3-D view of ${this.header.title}` });
    this.panes = new Panes(this.canvas, model);
    this.stage = h("main", { class: "stage", tabIndex: 0, "aria-label": "View of the scene; press ? for the keys" });
    this.loading = h("p", { class: "loading", role: "status" }, "Loading the scene…");
    this.said = h("div", { class: "said card", role: "status", "aria-live": "polite" });
    this.toast = h("p", { class: "toast", role: "alert", hidden: true });
    this.boxes = svg("svg", { class: "overlay boxes", "aria-hidden": "true" });
    this.help = makeHelp();
    this.top = makeTop(this);
    this.rail = makeRail(this);
    this.captions = makeCaptions(this);
    this.views = makeViews(this);
    this.photoOver = makePhoto();
    const act = { ask: (words) => this.ask(words), fit: () => this.fit(), duplicate: () => this.duplicate() };
    this.panel = makePanel(model, { ...act, save: () => this.saveState(), open: (file) => this.openFile(file), ...this.files() });
    const foot = h("div", { class: "foot" }, this.said, this.views.element);
    const over = [...this.photoOver.elements, this.boxes, this.rail.element, this.captions.element, foot, this.toast];
    this.stage.append(this.canvas, this.loading, ...over);
    root.classList.add("kfgs");
    root.setAttribute("aria-busy", "true");
    root.replaceChildren(this.top.element, this.stage, this.panel.element, this.help);
    this.setTheme(matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
  }

  async start() {
    const { panes, model } = this;
    const onlost = () => this.fail("The graphics card stopped drawing. Reload the page.");
    panes.start({ background: BACKGROUND[this.theme], onlost });
    this.showThings(this.header.things);
    this.eye = panes.eye = new Eye(this.header, model.extent(model.side));
    panes.ondraw = () => (this.drawMarks(), this.ondraw());
    this.tools = new Tools(this.stage, this.eye, this);
    if (Number.isInteger(this.header.default_view)) this.goTo(this.header.default_view);
    model.addEventListener("change", () => this.refresh());
    this.watch();
    await this.begin();
    await this.panes.settled(true);
    this.loading.remove();
    this.root.removeAttribute("aria-busy");
    if (this.alone) this.stage.focus({ preventScroll: true });
  }

  /** Show what Python showed: mode, question, gamma. */
  async begin() {
    const { show, words, gamma } = this.header.start ?? {};
    if (show in this.modes) this.panes.list[0].mode = show;
    if (words) await this.ask(words);
    if (words && gamma !== this.model.gamma) this.model.setGamma(gamma);
    this.model.past = [];
    this.refreshPanes();
  }

  watch() {
    const resize = () => {
      const { clientWidth: width, clientHeight: height } = this.root;
      for (const [name, most] of Object.entries(NARROW)) this.root.classList.toggle(name, width <= most);
      this.root.classList.toggle("low", height <= LOW);
      this.panes.resize(this.stage.clientWidth, this.stage.clientHeight);
    };
    const sizes = new ResizeObserver(resize);
    for (const one of [this.root, this.stage]) sizes.observe(one);
    resize();
    const until = new AbortController();
    const listen = (target, name, act) => target.addEventListener(name, act, { signal: until.signal });
    const keys = this.alone ? document : this.root; // on a page of its own: wherever the focus is
    listen(keys, "keydown", (event) => this.key(event));
    listen(keys, "keyup", (event) => this.tools.release(event));
    listen(window, "blur", () => this.tools.keys.clear());
    listen(this.root, "dragover", (event) => event.preventDefault());
    listen(this.root, "drop", (event) => (event.preventDefault(), this.openFile(event.dataTransfer.files[0])));
    listen(window, "beforeunload", (event) => this.alone && this.model.edited && event.preventDefault()); // the tab may close
    this.dispose = () => {
      until.abort();
      sizes.disconnect();
      this.urls.forEach((url) => URL.revokeObjectURL(url));
      this.panes.dispose();
      this.root.replaceChildren();
    };
  }

  /** Whether the page is the viewer's own, and not in a frame of another, which keeps its keys and scrolls. */
  get alone() {
    return this.root.parentElement === document.body && window === parent;
  }

  /** Resolves when the picture is that of the state. */
  settled() {
    return this.panes.settled();
  }

  // showing the state

  refresh() {
    this.panel.refresh();
    this.top.refresh();
    this.said.replaceChildren(...this.model.sentences().map((line) => h("p", {}, line)));
    this.panes.hurry();
  }

  refreshPanes() {
    this.panes.activate(0);
    this.panes.forgetCamera();
    this.captions.refresh();
    this.refresh();
  }

  /** Show a message for a while; "" hides it. */
  say(text) {
    this.toast.textContent = text;
    this.toast.hidden = !text;
    clearTimeout(this.toastTimer);
    if (text) this.toastTimer = setTimeout(() => (this.toast.hidden = true), SAID);
  }

  /** Say in place of the scene why it cannot be shown. */
  fail(text) {
    this.root.removeAttribute("aria-busy");
    this.loading.textContent = text;
    this.loading.setAttribute("role", "alert");
    this.stage.append(this.loading);
  }

  // what a person does

  /**
   * Search; a message says why there is no answer. No words clear the search. Only the last search is answered. Then keys are
   * those of the view, if they were those of the search box.
   */
  async ask(words) {
    const turn = (this.asking = {});
    const before = this.model.answer;
    const wanted = () => this.asking === turn && this.model.answer === before;
    const { element, input } = this.top.search;
    this.say("");
    element.removeAttribute("aria-busy");
    if (!words?.trim()) return this.model.ask(null);
    element.setAttribute("aria-busy", "true");
    try {
      const answer = await this.link.ask(words);
      if (!wanted()) return;
      this.model.ask(answer);
      if (document.activeElement === input) this.stage.focus({ preventScroll: true });
    } catch (error) {
      if (wanted()) this.say(error.message);
    } finally {
      if (this.asking === turn) element.removeAttribute("aria-busy");
    }
  }

  setMode(mode) {
    this.hidePhoto();
    this.panes.list[0].mode = mode;
    this.refreshPanes();
  }

  nextMode() {
    const modes = Object.keys(this.modes);
    this.setMode(modes[(modes.indexOf(this.panes.list[0].mode) + 1) % modes.length]);
  }

  setLayout(layout) {
    this.hidePhoto();
    this.panes.arrange(layout, this.modes);
    this.refreshPanes();
  }

  setSlider(place) {
    this.panes.slider = place;
    this.captions.place();
    this.panes.forgetCamera(); // the renderer forgets the old borders
    this.panes.hurry();
  }

  setTool(tool) {
    this.tools.setTool(tool);
    this.rail.set(tool);
  }

  setThrough(through) {
    this.through = through;
    this.rail.set(this.tools.tool);
  }

  setTheme(theme) {
    this.root.dataset.theme = this.theme = theme;
    if (!this.panes.renderer) return;
    this.panes.renderer.background = BACKGROUND[theme];
    this.panes.redraw();
  }

  async savePicture() {
    await this.settled();
    this.canvas.toBlob((blob) => download("kfgs.png", blob));
  }

  /** What only Python can do; nothing in an exported file. */
  files() {
    const { link, model } = this;
    if (!link.python) return {};
    const sides = (of) => Object.fromEntries(model.sides.map((side) => [side, of(side)]));
    const edits = () => sides((side) => model.editsOf(side));
    const lambda = () => (model.carried ? model.lambda : null);
    const asked = () => ({ words: model.words, gamma: model.gamma, lambda: lambda() });
    const wrote = (paths) => this.say(`Saved: ${paths.join(", ")}`);
    return {
      similar: this.header.examples && (() => this.attempt(async () => model.ask(await link.similar(model.meant())))),
      split: () => this.attempt(() => this.split()),
      saveSelection: () => this.attempt(async () =>
        wrote(await link.saveSelection({ ...asked(), edits: edits(), masks: sides((side) => model.selected(side)) }))),
      saveEdits: () => this.attempt(async () => wrote(await link.saveEdits(edits(), lambda()))),
    };
  }

  /** Do something, or say why it cannot be done. */
  async attempt(act) {
    try {
      return await act();
    } catch (error) {
      this.say(error.message);
    }
  }

  async split() {
    const { model } = this;
    const [side, name] = [model.side, model.words ?? "part"];
    model.setParts({ side, name, ...(await this.link.parts(side, model.selected(side), model.editsOf(side))) });
  }

  /** Copy the selection, to the right in the picture. */
  duplicate() {
    const { model, eye } = this;
    const found = model.extent(model.side);
    if (!found || !model.duplicate([0, 1, 2].map((axis) => ASIDE * found.radius * eye.view.R[axis]))) return;
    this.setTool("shift");
    this.say("Drag the copy into its place; F shows it.");
  }

  // the state: saved and opened

  saveState() {
    download("kfgs_view.json", new Blob([this.state()], { type: "application/json" }));
  }

  /** The state as JSON, with what the first pane shows from where. */
  state() {
    return JSON.stringify({ ...this.model.toJSON(), mode: this.panes.list[0].mode, view: this.eye.view });
  }

  /** Open a state that was saved; or a file of splats, through Python, in place of the scene. */
  openFile(file) {
    return file && this.attempt(async () => {
      if (/\.json$/i.test(file.name)) return this.open(await new Response(file).json().catch(() => null));
      if (file.size > MOST_BYTES) throw new Error(`${file.name} is too large here: run “kfgs view ${file.name}”.`);
      this.say(`Opening ${file.name} …`);
      location.assign(`../${await this.link.openFile(file)}/`);
    });
  }

  /** Show a state that `Model.toJSON` gave; without its question, if nobody answers that any more. */
  async open(saved) {
    const answer = saved?.words ? await this.attempt(() => this.link.ask(saved.words)) : null;
    this.model.fromJSON(saved, answer ?? null);
    const { mode, view } = saved;
    if (mode in this.modes) this.panes.list[0].mode = mode;
    if (possibleView(view)) {
      this.leaveView();
      this.eye.view = view;
    }
    this.showSide();
  }

  /** Show the side that the model has. */
  showSide() {
    this.panes.list[0].side = this.model.side;
    this.refreshPanes();
  }

  // what the tools ask for (see tools.js); places are CSS pixels of the stage

  /** A click picks, or puts an end of the tape; in a split view, counts are then of this pane's cloud. */
  click(x, y) {
    const { side } = this.panes.activate(x);
    if (this.tools.tool === "tape") return this.model.measure(this.panes.surface(x, y));
    this.model.pick(side, this.panes.under(x, y));
  }

  twice(x, y) {
    const { side } = this.panes.activate(x);
    const index = this.panes.under(x, y);
    if (index < 0) return;
    this.leaveView();
    this.glide(() => this.eye.setPivot(this.model.position(side, index)));
  }

  shape(polygon, how) {
    const { side } = this.panes.activate(polygon[0][0]);
    this.model.select(side, this.panes.inside(polygon, this.through), how);
  }

  /** Paint the selection with a round brush; a stroke is one step of undo. */
  brush(x, y, how, first) {
    const { side } = first ? this.panes.activate(x) : this.panes.active;
    const r = this.tools.radius;
    const round = Array.from({ length: 16 }, (_, k) => [x + r * Math.cos((k * Math.PI) / 8), y + r * Math.sin((k * Math.PI) / 8)]);
    this.model.select(side, this.panes.inside(round, this.through), first || how === "subtract" ? how : "add", !first);
  }

  /** Move the selected Gaussians with the pointer, parallel to the picture; `upward`: along the scene's upward direction. */
  shift(dx, dy, upward, first) {
    const { model, eye } = this;
    const found = model.extent(model.side);
    if (!found || !model.counts(model.side).selected) return this.say("Select something first, to move it.");
    const step = ahead(eye.view, found.center) / eye.focal;
    const [right, down, up] = [eye.view.R.slice(0, 3), eye.view.R.slice(3, 6), eye.up];
    const by = [0, 1, 2].map((axis) => step * (upward ? -dy * up[axis] : dx * right[axis] + dy * down[axis]));
    model.move(by, !first);
  }

  sizeBrush(factor) {
    this.tools.radius = Math.min(Math.max(this.tools.radius * factor, BRUSH[0]), BRUSH[1]);
  }

  // the camera

  /** A person moved the camera. */
  moved() {
    cancelAnimationFrame(this.gliding);
    this.leaveView();
    this.moves();
  }

  /** The camera is no longer at one of the scene's views. */
  leaveView() {
    if (this.view !== null) this.views.set(null);
    this.view = null;
    this.hidePhoto();
  }

  moves() {
    this.panes.forgetCamera();
    this.panes.hurry();
  }

  /** Change the camera over a third of a second. */
  glide(change) {
    const from = this.eye.view;
    change();
    const to = this.eye.view;
    cancelAnimationFrame(this.gliding);
    if (this.root.hasAttribute("aria-busy") || matchMedia("(prefers-reduced-motion: reduce)").matches) return this.moves();
    const start = performance.now();
    const step = (now) => {
      const t = Math.min(Math.max((now - start) / GLIDE, 0), 1);
      this.eye.view = between(from, to, t * t * (3 - 2 * t));
      this.moves();
      if (t < 1) this.gliding = requestAnimationFrame(step);
    };
    this.eye.view = from;
    this.gliding = requestAnimationFrame(step);
  }

  /** Move the camera so that the selection fills the view; without one, go to the first view, since a room has walls. */
  fit() {
    const { model, header } = this;
    const found = model.extent(model.side);
    if (!found) return;
    if (!model.counts(model.side).selected && Number.isInteger(header.default_view)) return this.goTo(header.default_view);
    this.leaveView();
    const from = model.counts(model.side).selected ? this.viewThatSees(found) : null;
    this.glide(() => this.eye.fit(found, from));
  }

  /** The nearest of the scene's cameras in whose picture a ball lies, or lies most completely; null without cameras. */
  viewThatSees({ center, radius }) {
    const { cameras } = this.header;
    const cost = ({ viewmat: m, K: [fx, fy, cx, cy], width, height }) => {
      const [x, y, z] = [0, 4, 8].map((row) => m[row] * center[0] + m[row + 1] * center[1] + m[row + 2] * center[2] + m[row + 3]);
      if (z < radius / 4) return Infinity; // behind it, or in the middle
      const out = (place, half, size) => (Math.max(0, half - place) + Math.max(0, place + half - size)) / size;
      const cut = out((fx * x) / z + cx, (fx * radius) / z, width) + out((fy * y) / z + cy, (fy * radius) / z, height);
      return 10 * cut + z / radius / 10;
    };
    return cameras.reduce((best, own) => (cost(own) < (best ? cost(best) : Infinity) ? own : best), null);
  }

  /** Go to a camera of the scene. */
  goTo(at) {
    this.view = at;
    this.glide(() => this.eye.lookThrough(this.header.cameras[at]));
    this.views.set(at);
    if (this.photo !== null) this.showPhoto(at);
  }

  /** Look through any camera, {viewmat, K, width, height, near}. */
  look(camera) {
    this.leaveView();
    this.glide(() => this.eye.lookThrough(camera));
  }

  /** Go to the next camera of the scene, or the one before. */
  step(by) {
    const count = this.header.cameras.length;
    if (count) this.goTo(((this.view ?? (by > 0 ? -1 : 0)) + by + count) % count);
  }

  // the photo over the view

  thumbnail(at) {
    const entry = this.header.buffers[this.header.cameras[at].thumbnail];
    if (entry && !this.urls.has(at)) {
      const bytes = this.packed.data.slice(entry.offset, entry.offset + entry.length);
      this.urls.set(at, URL.createObjectURL(new Blob([bytes], { type: "image/jpeg" })));
    }
    return this.urls.get(at) ?? null;
  }

  togglePhoto() {
    if (this.photo !== null) return this.hidePhoto();
    const at = this.view ?? this.nearestView();
    if (at === null) return;
    if (this.view === null) this.goTo(at);
    this.showPhoto(at);
  }

  /** The view with a photo that sees most nearly what is seen now; 60 degrees count as the radius of the scene. */
  nearestView() {
    const { position, R } = this.eye.view;
    let [best, least] = [null, Infinity];
    this.header.cameras.forEach(({ viewmat, thumbnail }, at) => {
      const own = viewOf(viewmat, 1);
      const away = Math.hypot(...own.position.map((value, axis) => value - position[axis])) / this.eye.ball.radius;
      const far = away + 2 * (1 - [6, 7, 8].reduce((all, k) => all + R[k] * own.R[k], 0));
      if (thumbnail && far < least) [best, least] = [at, far];
    });
    return best;
  }

  /** Lay the photo of a view over the scene, null: none. */
  showPhoto(at) {
    const url = at === null ? null : this.thumbnail(at);
    this.photo = url && at;
    this.eye.whole = url !== null;
    this.photoOver.show(url);
    this.panes.forgetCamera();
    this.refresh();
  }

  hidePhoto() {
    if (this.photo !== null) this.showPhoto(null);
  }

  /** Boxes of connected parts, what Python added, and the measuring tape. */
  drawMarks() {
    const { model, panes } = this;
    const { parts, name, side } = model.parts ?? { parts: [] };
    const boxes = parts.map(({ corners }, at) => ({ name: `${name} ${at + 1}`, places: corners }));
    const length = model.length === null ? "" : short(model.length);
    const tape = model.tape.length ? [{ name: length, places: model.tape }] : [];
    const shown = panes.layout === "slider" ? panes.list.slice(0, 1) : panes.list;
    const project = (place) => panes.project(place);
    this.boxes.replaceChildren(...shown.map((pane) => {
      const { x, width } = panes.viewport(pane);
      const place = { x: x / panes.ratio, width: width / panes.ratio, height: "100%" };
      return marksIn([...(pane.side === side ? boxes : []), ...this.marks, ...tape], place, project);
    }));
  }

  /** Show what Python added, by name (see kfgs/viewer/things.py), in place of what it had added before. */
  showThings(things) {
    const named = Object.entries(things);
    this.marks = named.flatMap(([name, { marks = [] }]) =>
      marks.map((places, at) => ({ name: marks.length > 1 ? `${name} ${at + 1}` : name, places })));
    this.panes.renderer.setSolids(named.map(([, thing]) => thing).filter(({ places }) => places));
    this.panes.hurry();
  }

  // keys

  key(event) {
    if (this.help.open || event.target.matches("input[type=text], input[type=search], select")) return;
    const { model } = this;
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (event.ctrlKey || event.metaKey) {
      const undo = () => (event.shiftKey ? model.redo() : model.undo());
      return void this.run({ z: undo, y: () => model.redo(), i: () => model.invert() }[key], event);
    }
    if (event.target.matches("input[type=range]") && key.startsWith("Arrow")) return;
    const keys = {
      "?": () => this.help.showModal(), "/": () => this.top.search.input.focus(), f: () => this.fit(),
      m: () => this.nextMode(), p: () => this.togglePhoto(), "[": () => this.step(-1), "]": () => this.step(1),
      x: () => this.setThrough(!this.through), r: () => (this.eye.roll(event.shiftKey ? ROLL : 0), this.moved()), ",": () => this.sizeBrush(0.8), ".": () => this.sizeBrush(1.25),
      Delete: () => model.remove(), Backspace: () => model.remove(),
      Escape: () => this.escape(),
    };
    for (const [tool, [, own]] of Object.entries(TOOLS)) keys[own] = () => this.setTool(tool);
    if (!this.run(keys[key], event) && this.tools.press(event)) event.preventDefault();
  }

  /** Take the tape away; else put the tool away; else select nothing. */
  escape() {
    const { tool } = this.tools;
    if (tool === "tape" && this.model.tape.length) this.model.measure(null);
    else if (tool === "move") this.model.clear();
    else this.setTool("move");
  }

  run(action, event) {
    if (!action) return false;
    event.preventDefault();
    action();
    return true;
  }
}

const possibleView = (view) =>
  [...(view?.R ?? []), ...(view?.position ?? []), view?.distance].filter(Number.isFinite).length === 13;

function possibleModes({ sides, buffers, classes }) {
  const color = sides.color || sides.semantic.sh_degree !== null;
  const classless = color && !classes.length;
  const absent = { color: !color, labels: classless, score: classless, latents: !buffers["semantic/latents"] };
  return Object.fromEntries(Object.entries(MODES).filter(([mode]) => !absent[mode]));
}
