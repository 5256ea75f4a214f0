/** What is on the canvas: one picture, two side by side, or two with a border that moves. Owns the renderer. */

import { gaussianAt, gaussiansIn, meeting } from "./pick.js";
import { Renderer } from "./renderer.js";

const MIXING = 0.7; // of the class colour over the Gaussian's own
const REST = 160; // milliseconds without a change, after which the picture is drawn in full

export class Panes {
  /** @param {object} model see model.js */
  constructor(canvas, model) {
    Object.assign(this, { canvas, model, layout: "one", slider: 0.5 });
    this.list = [{ mode: "labels", side: model.side }]; // what each pane shows
    this.active = this.list[0];
    this.ratio = 1; // device pixels in a CSS pixel
    this.ondraw = () => {};
  }

  /** Start WebGL; throws an Error with a sentence for people. */
  start(options) {
    const { model } = this;
    this.renderer = new Renderer(this.canvas, model.packed, { ...options, clouds: model.clouds });
    this.renderer.onorder = () => this.redraw();
  }

  dispose() {
    clearTimeout(this.resting);
    cancelAnimationFrame(this.frame);
    this.renderer?.dispose();
  }

  /** Arrange the panes: "one", "split" or "slider"; new ones show what the first does not. */
  arrange(layout, modes) {
    const [first] = this.list;
    const { sides } = this.model;
    const side = layout === "split" ? sides.find((one) => one !== first.side) ?? first.side : first.side;
    const mode = first.mode === "labels" && modes.color ? "color" : "labels";
    this.list = layout === "one" ? [first] : [first, { mode, side }];
    this.layout = layout;
  }

  /** The pane at a place (CSS pixels) becomes the active one: counts are of its side. */
  activate(x) {
    this.active = this.list[this.list.length > 1 && x * this.ratio >= this.border() ? 1 : 0];
    this.model.side = this.active.side;
    return this.active;
  }

  /** What pick.js needs to look into the active pane, and places (CSS pixels) in its picture. */
  into(...places) {
    this.prepare(this.active);
    const viewport = this.viewport(this.active);
    const drawn = this.model.drawn(this.active.side);
    const at = places.map(([x, y]) => [x * this.ratio - viewport.x, y * this.ratio]);
    return { drawn, ...this.renderer.seen(viewport), at };
  }

  /** The Gaussian at a place (CSS pixels) in the active pane, a selected one first; -1 if there is none. */
  under(x, y) {
    const { cloud, camera, drawn, at: [place] } = this.into([x, y]);
    const chosen = this.dims(this.active) ? this.model.selected(this.active.side) : null;
    const found = chosen ? gaussianAt(cloud, camera, ...place, chosen.map((on, i) => on & drawn[i])) : -1;
    return found >= 0 ? found : gaussianAt(cloud, camera, ...place, drawn);
  }

  /** Where the surface is that is seen at a place (CSS pixels) in the active pane, [x, y, z]; null: there is none. */
  surface(x, y) {
    const { cloud, camera, drawn, at: [place] } = this.into([x, y]);
    const index = gaussianAt(cloud, camera, ...place, drawn);
    return index < 0 ? null : meeting(cloud, index, camera, ...place);
  }

  /** A mask of the Gaussians seen in a polygon (CSS pixels) in the active pane; or `through` others, too. */
  inside(polygon, through) {
    const { cloud, camera, drawn, at } = this.into(...polygon);
    return gaussiansIn(cloud, at, camera, drawn, through);
  }

  /** Whether a pane dims what is not selected. The colours of scores say where gamma should be. */
  dims(pane) {
    return this.model.selecting && pane.mode !== "score";
  }

  /** Where a point is seen in each pane, CSS pixels; null behind the camera. */
  project(point) {
    const { viewmat: m, fx, fy, cx, cy, near } = this.camera;
    const [x, y, z] = [0, 4, 8].map((row) => m[row] * point[0] + m[row + 1] * point[1] + m[row + 2] * point[2] + m[row + 3]);
    if (!(z > near)) return null;
    return [(fx * x) / z + cx, (fy * y) / z + cy].map((value) => value / this.ratio);
  }

  resize(width, height) {
    this.ratio = Math.min(devicePixelRatio || 1, 2);
    this.canvas.width = Math.max(1, Math.round(width * this.ratio));
    this.canvas.height = Math.max(1, Math.round(height * this.ratio));
    this.forgetCamera();
    this.draw();
  }

  /** The camera or the arrangement changed. */
  forgetCamera() {
    this.camera = null;
  }

  redraw() {
    this.frame ??= requestAnimationFrame(() => this.draw());
  }

  /** Draw soon, if need be coarsely, and in full when nothing changes any more. */
  hurry() {
    this.rest();
    this.redraw();
  }

  /** What is drawn from now on may be coarse; when nothing changes any more, it is drawn in full. */
  rest() {
    this.moving = true;
    clearTimeout(this.resting);
    this.resting = setTimeout(() => ((this.moving = false), this.redraw()), REST);
  }

  /** Resolves when the picture is that of the state; a `coarse` one is drawn in full soon. */
  async settled(coarse = false) {
    if (coarse) this.rest();
    else this.moving = false;
    this.draw(); // and ask for the order of what is seen now
    await this.renderer.ordered();
    this.draw();
  }

  draw() {
    cancelAnimationFrame(this.frame);
    this.frame = null;
    this.placeCamera();
    for (const pane of this.list) {
      this.prepare(pane);
      this.renderer.draw({ ...this.viewport(pane), moving: this.moving });
    }
    this.ondraw();
  }

  /** Give the renderer the camera, if it moved: both panes have the same one. */
  placeCamera() {
    if (this.camera) return;
    const { width, height } = this.canvas;
    this.camera = this.eye.at(this.layout === "split" ? Math.floor(width / 2) : width, height);
    this.eye.focal = this.camera.fx / this.ratio;
    this.renderer.camera = this.camera;
  }

  /** The camera of the last picture in the form of the pack's. */
  lens() {
    if (!this.camera) this.placeCamera();
    const { viewmat, fx, fy, cx, cy, width, height, near } = this.camera;
    return { name: "", width, height, near, viewmat: [...viewmat], K: [fx, fy, cx, cy] };
  }

  /** Where a pane is, device pixels from the top left of the canvas. Both sides of the slider are parts of one picture. */
  viewport(pane) {
    const { width, height } = this.canvas;
    const whole = { x: 0, y: 0, width, height };
    if (this.layout === "one") return whole;
    const border = this.border();
    const second = pane === this.list[1];
    const part = { x: second ? border : 0, y: 0, width: second ? width - border : border, height };
    return this.layout === "slider" ? { ...whole, clip: part } : { ...part, width: Math.floor(width / 2) };
  }

  /** Where the second pane begins, device pixels. */
  border() {
    return Math.round(this.canvas.width * (this.layout === "slider" ? this.slider : 0.5));
  }

  /** Give the renderer a pane's side, cloud and look. */
  prepare(pane) {
    const { model, renderer } = this;
    const { answer } = model;
    renderer.side = pane.side;
    renderer.update(model.clouds[pane.side], model.byHand ? model.selected(pane.side) : null);
    const [low, high] = answer ? [answer.low, answer.high] : model.packed.header.clim;
    const hidden = new Uint8Array(model.names.length + 1);
    for (const label of model.hidden) hidden[label < 0 ? model.names.length : label] = 1;
    renderer.setLook({
      mode: pane.mode, scores: answer?.scores ?? null, gamma: model.gamma ?? 0, lambda: model.lambda,
      low, high, hidden, mixing: pane.mode === "labels" ? MIXING : 1,
      dim: this.dims(pane),
    });
  }
}
