/** Pointer and keys over the view: orbit, pan, zoom, fly, click; box, lasso, brush; moving the selection. */

import { svg } from "./dom.js";

const CLICK = 5; // pixels that a click may move
const FAST = 3; // times as fast with Shift
const FLY_KEYS = { w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], q: [0, -1, 0], e: [0, 1, 0] };
const TURN_KEYS = { ArrowLeft: [-24, 0], ArrowRight: [24, 0], ArrowUp: [0, -24], ArrowDown: [0, 24] };

export class Tools {
  /**
   * @param {HTMLElement} stage what the pointer works on
   * @param {Eye} eye the camera
   * @param {{moved(), click(x, y), twice(x, y), shape(polygon, how),
   *   brush(x, y, how, first), shift(dx, dy, upward, first)}} on places are CSS pixels of the stage; `how`:
   *   replace, add, subtract
   */
  constructor(stage, eye, on) {
    Object.assign(this, { stage, eye, on, tool: "move", points: new Map(), how: "replace", keys: new Set(), drag: null });
    this.radius = 24; // of the brush, pixels
    this.overlay = svg("svg", { class: "overlay", "aria-hidden": "true" });
    stage.append(this.overlay);
    const listen = (name, handler) => stage.addEventListener(name, handler.bind(this), { passive: false });
    listen("pointerdown", this.down);
    listen("pointermove", this.move);
    listen("pointerup", this.up);
    listen("pointercancel", this.cancel);
    listen("pointerleave", () => {
      if (!this.drag) this.overlay.replaceChildren();
    });
    listen("wheel", this.wheel);
    listen("dblclick", (event) => this.tool === "move" && this.on.twice(...this.place(event)));
    listen("contextmenu", (event) => event.preventDefault());
  }

  setTool(tool) {
    this.tool = tool;
    this.stage.dataset.tool = tool;
    this.overlay.replaceChildren();
  }

  place(event) {
    const box = this.stage.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  down(event) {
    if (event.target.closest("button, input, select, .card")) return;
    if (event.button === 1) event.preventDefault(); // no scrolling by the middle button
    this.stage.focus({ preventScroll: true });
    this.stage.setPointerCapture(event.pointerId);
    const place = this.place(event);
    this.points.set(event.pointerId, place);
    if (this.points.size > 1) return this.cancelShape();
    const selects = this.tool !== "move" && this.tool !== "tape" && event.button === 0;
    const looks = event.button === 1 || (event.button === 0 && (event.ctrlKey || event.metaKey));
    const kind = selects ? this.tool : looks ? "look" : event.button === 0 && !event.shiftKey ? "orbit" : "pan";
    const how = event.altKey ? "subtract" : event.shiftKey ? "add" : this.how;
    this.drag = { kind, how, start: place, last: place, path: [place], far: 0 };
    if (kind === "brush") this.paint(place, true);
  }

  move(event) {
    const place = this.place(event);
    if (this.tool === "brush" && !this.points.size) this.circle(place, this.radius);
    if (!this.points.has(event.pointerId)) return;
    if (this.points.size === 2) return this.pinch(event.pointerId, place);
    this.points.set(event.pointerId, place);
    if (this.drag) this.pull(place);
  }

  pull(place) {
    const { drag, eye } = this;
    const [dx, dy] = [place[0] - drag.last[0], place[1] - drag.last[1]];
    drag.far = Math.max(drag.far, Math.hypot(place[0] - drag.start[0], place[1] - drag.start[1]));
    drag.last = place;
    if (["orbit", "pan", "look"].includes(drag.kind)) {
      if (drag.far < CLICK) return;
      if (drag.kind === "pan") eye.pan(dx, dy);
      else if (drag.kind === "look" || this.keys.size || eye.loose) eye.turn(dx, dy);
      else eye.orbit(dx, dy);
      this.on.moved();
    } else if (drag.kind === "brush") this.paint(place, false);
    else if (drag.kind === "shift") {
      this.on.shift(dx, dy, drag.how === "add", !drag.begun);
      drag.begun = true;
    } else {
      drag.path = drag.kind === "box" ? corners(drag.start, place) : [...drag.path, place];
      this.outline(drag.path);
    }
  }

  up(event) {
    this.points.delete(event.pointerId);
    const { drag } = this;
    if (!drag || this.points.size) return;
    this.drag = null;
    if (drag.kind !== "brush" && drag.far < CLICK) this.on.click(...drag.start);
    else if (drag.kind === "box" || drag.kind === "lasso") this.on.shape(drag.path, drag.how);
    if (drag.kind !== "brush") this.overlay.replaceChildren();
  }

  cancel(event) {
    this.points.delete(event.pointerId);
    this.cancelShape();
  }

  cancelShape() {
    this.drag = null;
    this.overlay.replaceChildren();
  }

  /** Two fingers: their distance zooms, their middle pans. */
  pinch(id, place) {
    const before = [...this.points.values()];
    this.points.set(id, place);
    const after = [...this.points.values()];
    const apart = ([a, b]) => Math.hypot(a[0] - b[0], a[1] - b[1]) || 1;
    const middle = ([a, b], axis) => (a[axis] + b[axis]) / 2;
    this.eye.zoom(apart(before) / apart(after));
    this.eye.pan(middle(after, 0) - middle(before, 0), middle(after, 1) - middle(before, 1));
    this.on.moved();
  }

  wheel(event) {
    if (event.target.closest(".card") || (window !== parent && !document.hasFocus())) return; // in a frame: after a click
    event.preventDefault();
    const lines = event.deltaMode ? 30 : 1;
    this.eye.zoom(Math.exp(Math.min(Math.max(event.deltaY * lines, -200), 200) / 600));
    this.on.moved();
  }

  paint(place, first) {
    this.circle(place, this.radius);
    this.on.brush(...place, this.drag.how, first);
  }

  circle([cx, cy], r) {
    this.overlay.replaceChildren(svg("circle", { cx, cy, r }));
  }

  outline(path) {
    this.overlay.replaceChildren(svg("polygon", { points: path.map((one) => one.join(",")).join(" ") }));
  }

  /** A key went down; true if it moves the camera. */
  press(event) {
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (event.ctrlKey || event.metaKey || event.altKey) return false;
    this.fast = event.shiftKey;
    if (TURN_KEYS[key]) this.eye.orbit(...TURN_KEYS[key]);
    else if (key === "+" || key === "-") this.eye.zoom(key === "+" ? 0.9 : 1 / 0.9);
    else if (FLY_KEYS[key]) this.keys.add(key);
    else return false;
    if (FLY_KEYS[key] && this.keys.size === 1 && !this.timer) this.fly(performance.now());
    this.on.moved();
    return true;
  }

  release(event) {
    this.keys.delete(event.key.toLowerCase());
    this.fast = event.shiftKey;
  }

  fly(before) {
    this.timer = requestAnimationFrame((now) => {
      this.timer = null;
      if (!this.keys.size) return;
      const seconds = Math.min((now - before) / 1000, 0.2) * (this.fast ? FAST : 1);
      this.eye.fly(seconds, [0, 1, 2].map((axis) => [...this.keys].reduce((all, key) => all + FLY_KEYS[key][axis], 0)));
      this.on.moved();
      this.fly(now);
    });
  }
}

const corners = ([x, y], [u, v]) => [[x, y], [u, y], [u, v], [x, v]];
