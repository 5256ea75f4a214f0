/** The viewer's interface: `mount` puts it into an element. Data come from a pack, answers from a link. */

import { choice, download, h, iconButton, searchBox, select, textButton } from "./dom.js";
import { viewOf } from "./camera.js";
import { Eye } from "./eye.js";
import { suggestions } from "./link.js";
import { Model, whole } from "./model.js";
import { makePanel } from "./panel.js";
import { Renderer } from "./renderer.js";
import { Tools } from "./tools.js";

const MODES = { color: "Colour", labels: "Classes", score: "Score", latents: "Latents" };
const TOOLS = { move: ["Move the view", "1"], box: ["Box selection", "2"], lasso: ["Lasso selection", "3"], brush: ["Brush selection", "4"] };
const BACKGROUND = { light: [0.957, 0.961, 0.969], dark: [0.094, 0.102, 0.118] };
const MIXING = 0.7; // of the class colour over the Gaussian's own
const REST = 160; // milliseconds without a move, after which the picture is drawn in full
const GLIDE = 350; // milliseconds of a move to another view
const BRUSH = [6, 24, 120]; // pixels: smallest, first, largest radius
const HELP = [
  ["Drag", "turn the view"], ["Right drag, Shift + drag", "move it sideways"], ["Wheel, two fingers, + −", "zoom"],
  ["W A S D, Q E", "fly (Shift: faster)"], ["Click", "pick a Gaussian"], ["Double click", "turn about this point"],
  ["F", "fit the selection, or everything"], ["[ ]", "previous and next photo view"], ["P", "photo over the view"],
  ["/", "search"], ["M", "next colour mode"], ["1 2 3 4", "move, box, lasso, brush"], [", .", "smaller and larger brush"],
  ["Shift or Alt + tool", "add to or subtract from the selection"], ["Delete", "remove the selection"], ["Ctrl + I", "invert the selection"],
  ["Ctrl + Z, Ctrl + Shift + Z", "undo, redo"], ["Escape", "move tool, then clear the selection"],
];

/**
 * Show a scene in an element.
 * @param {HTMLElement} root filled and given a size by the page
 * @param {{header: object, data: ArrayBuffer}} packed see kfgs/viz/explorer/pack.py
 * @param {object} link see link.js
 * @returns {Promise<App>} has `model`, `renderer`, `eye`, `ask(words)`, `settled()`, `dispose()`
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
    this.modes = this.possibleModes();
    this.panes = [{ mode: "color" in this.modes ? "color" : "labels", side: this.model.side }];
    this.pane = this.panes[0];
    this.layout = "one";
    this.slider = 0.5;
    this.brushRadius = BRUSH[1];
    this.sent = {}; // side -> masks that the renderer has
    this.photo = null;
    this.build();
  }

  possibleModes() {
    const { sides, buffers } = this.header;
    const colored = sides.color || sides.semantic.sh_degree !== null;
    const absent = { color: !colored, latents: !buffers["semantic/latents"] };
    return Object.fromEntries(Object.entries(MODES).filter(([mode]) => !absent[mode]));
  }

  async start() {
    this.canvas = h("canvas", { role: "img", "aria-label": `3-D view of ${this.header.title}` });
    this.stage.prepend(this.canvas);
    const lost = () => this.fail("The graphics card stopped drawing. Reload the page.");
    this.renderer = await Renderer.create(this.canvas, { background: BACKGROUND[this.theme], onlost: lost });
    this.renderer.load(this.packed);
    this.renderer.onorder = () => this.redraw();
    for (const side of this.model.sides) this.model.positions[side] = this.renderer.means(side);
    this.eye = new Eye(this.header, this.model.extent(this.model.side));
    this.tools = new Tools(this.stage, this.eye, this);
    this.firstView();
    this.model.addEventListener("change", () => this.refresh());
    this.watch();
    await this.begin();
    await this.settled();
    this.root.removeAttribute("aria-busy");
    this.loading.remove();
    this.stage.focus({ preventScroll: true });
  }

  /** Show what Python showed: mode, hidden classes, question, gamma. */
  async begin() {
    const { show, hidden = [], words, gamma } = this.header.start ?? {};
    if (show in this.modes) this.panes[0].mode = show;
    this.model.setHidden(hidden);
    if (words) await this.ask(words);
    if (words) this.model.setGamma(gamma);
    this.model.past = [];
    this.refreshPanes();
  }

  // the elements

  build() {
    this.theme = matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";
    this.root.classList.add("kfgs");
    this.root.dataset.theme = this.theme;
    this.root.setAttribute("aria-busy", "true");
    this.stage = h("main", { class: "stage", tabIndex: 0, "aria-label": "View of the scene; press ? for the keys" });
    this.loading = h("p", { class: "loading", role: "status" }, "Loading the scene…");
    this.said = h("div", { class: "said card", role: "status", "aria-live": "polite" });
    this.toast = h("p", { class: "toast", role: "alert", hidden: true });
    this.panel = makePanel(this.model, { ask: (words) => this.ask(words), fit: () => this.fit(), saveJson: () => this.saveJson(), ...this.files() });
    this.help = h("dialog", { class: "help", "aria-label": "Keys" }, h("h2", {}, "Keys and mouse"), helpList(), textButton("Close", () => this.help.close()));
    this.stage.append(this.loading, this.makeRail(), this.makeCaptions(), ...this.makePhoto(), h("div", { class: "foot" }, this.said, this.makeViews()), this.toast);
    this.root.replaceChildren(this.makeTop(), this.stage, this.panel.element, this.help);
  }

  makeTop() {
    const { model } = this;
    const names = model.names.filter((_, label) => model.own.includes(label));
    this.search = searchBox({
      label: "Search for a class", placeholder: this.link.phrases ? "Search for anything" : "Search for a class",
      suggest: (text) => (text === model.answer?.words ? suggestions("", names) : suggestions(text, names)),
      describe: (name) => [h("span", {}, name), h("small", {}, whole(model.counts(model.side).classes[model.names.indexOf(name)]))],
      onchoose: (words) => this.ask(words), onclear: () => model.ask(null),
    });
    const modes = Object.entries(this.modes).map(([mode, text]) => [mode, text, `Show ${text.toLowerCase()} (M)`]);
    if (this.header.cameras.some((one) => one.thumbnail)) modes.unshift(["photo", "Photo", "Lay the photo of the nearest view over the scene (P)"]);
    this.modeChoice = choice("Colours", modes, (mode) => (mode === "photo" ? this.togglePhoto() : this.setMode(mode)));
    const layouts = [["one", "One view"], ["split", "Side by side"], ["slider", "Slider"]];
    this.layoutSelect = select("Views", layouts, "one", (layout) => this.setLayout(layout));
    this.undoButton = iconButton("undo", "Undo", () => model.undo(), { key: "Ctrl+Z" });
    this.redoButton = iconButton("redo", "Redo", () => model.redo(), { key: "Ctrl+Shift+Z" });
    return h(
      "header", { class: "top" }, h("h1", {}, this.header.title || "kfgs"), this.search.element, this.modeChoice.element, this.layoutSelect,
      h("span", { class: "tools" }, this.undoButton, this.redoButton,
        iconButton("camera", "Save a picture", () => this.savePicture()),
        iconButton("theme", "Dark or light", () => this.setTheme(this.theme === "dark" ? "light" : "dark")),
        iconButton("help", "Keys and mouse", () => this.help.showModal(), { key: "?" }),
        iconButton("panel", "Show or hide the panel", () => this.root.classList.toggle("no-panel"))),
    );
  }

  makeRail() {
    this.rail = new Map(Object.entries(TOOLS).map(([tool, [label, key]]) => [tool, iconButton(tool, label, () => this.setTool(tool), { key, "aria-pressed": String(tool === "move") })]));
    return h("div", { class: "rail card", role: "toolbar", "aria-label": "Tools", "aria-orientation": "vertical" }, ...this.rail.values(), iconButton("fit", "Fit the selection, or everything", () => this.fit(), { key: "F" }));
  }

  /** What each pane shows, at its upper edge; only the side to choose if there is one pane. */
  makeCaptions() {
    this.captions = h("div", { class: "captions" });
    return this.captions;
  }

  fillCaptions() {
    const { sides } = this.model;
    const captions = this.panes.map((pane, at) => {
      const choices = sides.flatMap((side) => Object.entries(this.modes).map(([mode, text]) => [`${side} ${mode}`, `${cloudName(side)}: ${text.toLowerCase()}`]));
      const set = (value) => ([pane.side, pane.mode] = value.split(" "), this.refreshPanes());
      if (this.panes.length > 1) return select(`View ${at + 1}`, choices, `${pane.side} ${pane.mode}`, set);
      if (sides.length < 2) return null;
      return select("Cloud", sides.map((side) => [side, cloudName(side)]), pane.side, (side) => ((pane.side = side), this.refreshPanes()));
    });
    this.divider = h("input", { type: "range", class: "divider", min: 0, max: 1, step: 0.005, value: this.slider, "aria-label": "Border between the two pictures", oninput: (event) => this.setSlider(Number(event.target.value)) });
    this.line = h("span", { class: "line", hidden: this.layout === "one" });
    this.captions.className = `captions ${this.layout}`;
    this.captions.replaceChildren(...captions.filter(Boolean), this.line, ...(this.layout === "slider" ? [this.divider] : []));
    this.line.style.left = `${100 * (this.layout === "slider" ? this.slider : 0.5)}%`;
  }

  /** Buttons that go to the scene's cameras, with their thumbnails. */
  makeViews() {
    this.viewButtons = this.header.cameras.map((camera, at) => {
      const [url, label] = [this.thumbnail(at), `Go to ${camera.name || `view ${at + 1}`}`];
      const content = url ? h("img", { src: url, alt: "", loading: "lazy" }) : String(at + 1);
      return h("button", { type: "button", title: label, "aria-label": label, onclick: () => this.goTo(at) }, content);
    });
    return h("div", { class: "views card", role: "group", "aria-label": "The scene's views", hidden: !this.viewButtons.length, onwheel: (event) => (event.currentTarget.scrollLeft += event.deltaY) }, ...this.viewButtons);
  }

  /** The photo of a view, to lay over the scene, and its opacity. */
  makePhoto() {
    this.photoImage = h("img", { class: "photo", alt: "", hidden: true });
    const fade = () => (this.photoImage.style.opacity = this.opacity.value);
    this.opacity = h("input", { type: "range", min: 0, max: 1, step: 0.01, value: 1, "aria-label": "Opacity of the photo", oninput: fade });
    this.opacityLabel = h("label", { class: "pair card photo-opacity", hidden: true }, "Photo", this.opacity);
    return [this.photoImage, this.opacityLabel];
  }

  thumbnail(at) {
    const entry = this.header.buffers[this.header.cameras[at].thumbnail];
    if (!entry) return null;
    this.urls ??= new Map();
    if (!this.urls.has(at)) this.urls.set(at, URL.createObjectURL(new Blob([this.packed.data.slice(entry.offset, entry.offset + entry.length)], { type: "image/jpeg" })));
    return this.urls.get(at);
  }

  // what a person does

  /** Search; a message says why there is no answer. */
  async ask(words) {
    this.say("");
    this.search.element.setAttribute("aria-busy", "true");
    try {
      this.model.ask(await this.link.ask(words));
    } catch (error) {
      this.say(error.message);
    } finally {
      this.search.element.removeAttribute("aria-busy");
    }
  }

  say(text) {
    this.toast.textContent = text;
    this.toast.hidden = !text;
    clearTimeout(this.toastTimer);
    if (text) this.toastTimer = setTimeout(() => (this.toast.hidden = true), 9000);
  }

  fail(text) {
    this.root.removeAttribute("aria-busy");
    this.loading.textContent = text;
    this.loading.setAttribute("role", "alert");
    this.stage.append(this.loading);
  }

  setMode(mode) {
    this.hidePhoto();
    this.panes[0].mode = mode;
    this.refreshPanes();
  }

  nextMode() {
    const modes = Object.keys(this.modes);
    this.setMode(modes[(modes.indexOf(this.panes[0].mode) + 1) % modes.length]);
  }

  setLayout(layout) {
    this.hidePhoto();
    this.layout = this.layoutSelect.value = layout;
    const [first] = this.panes;
    const other = this.model.sides.length > 1 && layout === "split" ? this.model.sides.find((side) => side !== first.side) : first.side;
    this.panes = layout === "one" ? [first] : [first, { mode: first.mode === "labels" && this.modes.color ? "color" : "labels", side: other }];
    this.refreshPanes();
  }

  setSlider(place) {
    this.slider = this.divider.value = place;
    this.line.style.left = `${100 * place}%`;
    this.camera = null; // the renderer forgets the old borders
    this.redraw();
  }

  setTool(tool) {
    this.tools.setTool(tool);
    this.rail.forEach((button, own) => button.setAttribute("aria-pressed", String(own === tool)));
  }

  setTheme(theme) {
    this.theme = theme;
    this.root.dataset.theme = theme;
    this.renderer.background = BACKGROUND[theme];
    this.redraw();
  }

  /** A click picks; in a split view it also makes this pane the one that counts are of. */
  click(x, y) {
    const { side } = this.activate(x);
    this.model.pick(side, this.under(x, y));
  }

  twice(x, y) {
    const { side } = this.activate(x);
    const index = this.under(x, y);
    if (index < 0) return;
    this.glide(() => this.eye.setPivot(this.model.position(side, index), true));
  }

  /** A drag begins: turn about what is in the middle of the picture. */
  grab() {
    if (!this.eye.loose) return;
    const index = this.under(this.stage.clientWidth / (this.layout === "split" ? 4 : 2), this.stage.clientHeight / 2, this.panes[0]);
    if (index >= 0) this.eye.setPivot(this.model.position(this.panes[0].side, index));
  }

  shape(polygon, how) {
    const pane = this.activate(polygon[0][0]);
    this.prepare(pane);
    this.model.select(pane.side, this.renderer.within({ polygon: polygon.map((place) => place.map((value) => value * this.ratio)) }), how);
  }

  /** Paint the selection: a ball around the Gaussian under the pointer, as wide as the brush there. */
  brush(x, y, how, first) {
    const { side } = first ? this.activate(x) : this.pane;
    const index = this.under(x, y);
    if (index < 0) return;
    const center = this.model.position(side, index);
    const { viewmat } = this.camera;
    const depth = viewmat[8] * center[0] + viewmat[9] * center[1] + viewmat[10] * center[2] + viewmat[11];
    this.model.paint(side, this.model.ball(side, center, (this.brushRadius * depth) / this.eye.focal), how, first);
  }

  /** The Gaussian at a place of the stage, in the active pane; -1 if there is none. */
  under(x, y, pane = this.pane) {
    this.prepare(pane);
    return this.renderer.pick(x * this.ratio, y * this.ratio);
  }

  /** Move the camera so that the selection, or everything, fills the view. */
  fit() {
    const found = this.model.extent(this.model.side);
    if (found) this.glide(() => this.eye.fit(found));
  }

  goTo(at) {
    this.view = at;
    this.glide(() => this.eye.lookThrough(this.header.cameras[at]));
    this.viewButtons.forEach((button, own) => button.setAttribute("aria-current", String(own === at)));
    this.viewButtons[at].scrollIntoView({ block: "nearest", inline: "nearest" });
  }

  step(by) {
    const count = this.header.cameras.length;
    if (count) this.goTo(((this.view ?? (by > 0 ? -1 : 0)) + by + count) % count);
    if (this.photo !== null) this.showPhoto(this.view);
  }

  togglePhoto() {
    if (this.photo !== null) return this.hidePhoto();
    const at = this.atView ? this.view : this.nearestView();
    if (at === null) return;
    this.goTo(at);
    this.showPhoto(at);
  }

  nearestView() {
    const here = this.eye.view.position;
    let [best, least] = [null, Infinity];
    this.header.cameras.forEach(({ viewmat, thumbnail }, at) => {
      const far = viewOf(viewmat, 1).position.reduce((all, value, axis) => all + (value - here[axis]) ** 2, 0);
      if (thumbnail && far < least) [best, least] = [at, far];
    });
    return best;
  }

  showPhoto(at) {
    const url = this.thumbnail(at);
    if (!url) return this.hidePhoto();
    this.photo = at;
    this.photoImage.src = url;
    this.photoImage.hidden = this.opacityLabel.hidden = false;
    this.refreshPanes();
  }

  hidePhoto() {
    if (this.photo === null) return;
    this.photo = null;
    this.photoImage.hidden = this.opacityLabel.hidden = true;
    this.refreshPanes();
  }

  async savePicture() {
    await this.settled();
    const blob = await new Promise((done) => this.canvas.toBlob(done));
    download("kfgs.png", blob);
  }

  /** What only Python can do; nothing in an exported file. */
  files() {
    const { link, model } = this;
    if (!link.python) return {};
    const masks = () => Object.fromEntries(model.sides.map((side) => [side, model.selected(side)]));
    const sides = (all) => Object.fromEntries(model.sides.map((side) => [side, all[side]]));
    const lambda = () => (model.source ? model.lambda : null);
    return {
      describe: (side, index) => link.describe(side, index),
      saveSelection: () => this.save(() => link.saveSelection({ words: model.answer?.words ?? null, gamma: model.gamma, lambda: lambda(), masks: masks() })),
      saveEdits: () => this.save(() => link.saveEdits(sides(model.toJSON()), lambda())),
    };
  }

  async save(write) {
    try {
      this.say(`Saved: ${(await write()).join(", ")}`);
    } catch (error) {
      this.say(error.message);
    }
  }

  saveJson() {
    download("kfgs_selection.json", new Blob([JSON.stringify(this.model)], { type: "application/json" }));
  }

  // the camera

  firstView() {
    const at = this.header.default_view;
    if (at !== null && at !== undefined) this.goTo(at);
  }

  /** Change the camera over a third of a second. */
  glide(change) {
    const from = this.eye.view;
    change();
    const to = this.eye.view;
    cancelAnimationFrame(this.gliding);
    if (!this.started || matchMedia("(prefers-reduced-motion: reduce)").matches) return this.redraw();
    const start = performance.now();
    const step = (now) => {
      const t = Math.min(Math.max((now - start) / GLIDE, 0), 1);
      this.eye.toward(from, to, t * t * (3 - 2 * t));
      this.moves();
      if (t < 1) this.gliding = requestAnimationFrame(step);
    };
    this.eye.view = from;
    this.gliding = requestAnimationFrame(step);
  }

  /** A person moved the camera. */
  moved() {
    cancelAnimationFrame(this.gliding);
    this.viewButtons[this.view]?.removeAttribute("aria-current");
    this.view = null;
    this.hidePhoto();
    this.moves();
  }

  /** The camera moves. */
  moves() {
    this.camera = null;
    this.hurry();
  }

  /** Draw soon, if need be coarsely, and in full when nothing changes any more. */
  hurry() {
    this.moving = true;
    clearTimeout(this.resting);
    this.resting = setTimeout(() => ((this.moving = false), this.redraw()), REST);
    this.redraw();
  }

  // drawing

  watch() {
    const sizes = new ResizeObserver(() => this.resize());
    sizes.observe(this.stage);
    this.resize();
    const until = new AbortController();
    const listen = (target, name, act) => target.addEventListener(name, act, { signal: until.signal });
    const alone = this.root.parentElement === document.body; // a page of its own: keys work wherever the focus is
    listen(alone ? document : this.root, "keydown", (event) => this.key(event));
    listen(alone ? document : this.root, "keyup", (event) => this.tools.release(event));
    listen(window, "blur", () => this.tools.releaseAll());
    this.started = true;
    this.dispose = () => {
      until.abort();
      sizes.disconnect();
      clearTimeout(this.resting);
      this.urls?.forEach((url) => URL.revokeObjectURL(url));
      this.renderer.dispose();
      this.root.replaceChildren();
    };
  }

  resize() {
    this.ratio = Math.min(devicePixelRatio || 1, 2);
    this.canvas.width = Math.max(1, Math.round(this.stage.clientWidth * this.ratio));
    this.canvas.height = Math.max(1, Math.round(this.stage.clientHeight * this.ratio));
    this.camera = null;
    this.draw();
  }

  redraw() {
    this.frame ??= requestAnimationFrame(() => this.draw());
  }

  /** Resolves when the picture is that of the state. */
  async settled() {
    this.moving = false;
    this.draw();
    await this.renderer.settled();
    this.draw();
  }

  draw() {
    cancelAnimationFrame(this.frame);
    this.frame = null;
    this.placeCamera();
    for (const pane of this.panes) {
      this.prepare(pane);
      this.renderer.draw({ ...this.viewport(pane), moving: this.moving });
    }
    this.placePhoto();
  }

  /** Give the renderer the camera, if it moved: both panes have the same one. */
  placeCamera() {
    if (this.camera) return;
    const { width, height } = this.canvas;
    this.camera = this.eye.at(this.layout === "split" ? Math.floor(width / 2) : width, height);
    this.eye.focal = this.camera.fx / this.ratio;
    this.renderer.setCamera(this.camera);
  }

  /** Where a pane is, device pixels from the top left of the canvas. Both sides of the slider are parts of one picture. */
  viewport(pane) {
    const { width, height } = this.canvas;
    const second = pane === this.panes[1];
    const whole = { x: 0, y: 0, width, height };
    if (this.layout === "one") return whole;
    const border = this.border();
    const part = { x: second ? border : 0, y: 0, width: second ? width - border : border, height };
    return this.layout === "slider" ? { ...whole, clip: part } : { ...part, width: Math.floor(width / 2) };
  }

  /** Where the second pane begins. */
  border() {
    return Math.round(this.canvas.width * (this.layout === "slider" ? this.slider : 0.5));
  }

  /** Give the renderer a pane's side, masks and look. */
  prepare(pane) {
    const { model, renderer } = this;
    renderer.setSide(pane.side);
    this.sendMasks(pane.side);
    const { answer } = model;
    const [low, high] = answer ? [answer.low, answer.high] : this.header.clim;
    const hidden = new Uint8Array(model.names.length + 1);
    for (const label of model.hidden) hidden[label < 0 ? model.names.length : label] = 1;
    renderer.setLook({
      mode: pane.mode, question: answer ? this.question(answer) : null, gamma: model.gamma ?? 0, lambda: model.lambda,
      low, high, hidden, mixing: pane.mode === "labels" ? MIXING : 1,
      dim: model.selecting && pane.mode !== "score", // the colours of the rest say where gamma should be
    });
  }

  /** What the renderer calls a question; scores that came from Python are sent once. */
  question(answer) {
    if (answer.number === undefined) {
      answer.number = answer.words;
      this.renderer.setScores(answer.words, answer.scores);
    }
    return answer.number;
  }

  /** Send the masks that changed since the last time. */
  sendMasks(side) {
    const { renderer, model } = this;
    const { now } = model;
    const sent = (this.sent[side] ??= {});
    const send = (name, value, key, set) => {
      if ((sent[name] ?? null) !== key) set(value);
      sent[name] = key;
    };
    const selected = model.byHand ? model.selected(side) : null;
    send("selected", selected, selected && now.id, (mask) => renderer.setMask("selected", mask));
    for (const [name, set] of [["removed", (mask) => renderer.setMask("removed", mask)], ["opacity", (mask) => renderer.setFade(mask)], ["colors", (rgba) => renderer.setColors(rgba)]])
      send(name, now[name][side] ?? null, now[name][side] ?? null, set);
  }

  /** The pane at a place becomes the active one. */
  activate(x) {
    this.pane = this.panes.length > 1 && x * this.ratio >= this.border() ? this.panes[1] : this.panes[0];
    this.model.side = this.pane.side;
    return this.pane;
  }

  placePhoto() {
    if (this.photo === null) return;
    const { width, height } = this.header.cameras[this.photo];
    const [W, H] = [this.stage.clientWidth, this.stage.clientHeight];
    const scale = Math.min(W / width, H / height);
    this.photoImage.style.cssText += `;width:${width * scale}px;height:${height * scale}px;left:${(W - width * scale) / 2}px;top:${(H - height * scale) / 2}px`;
  }

  // showing the state

  refreshPanes() {
    this.pane = this.panes[0];
    this.model.side = this.pane.side;
    this.camera = null;
    this.fillCaptions();
    this.refresh();
  }

  refresh() {
    const { model } = this;
    this.panel.refresh();
    this.search.set(model.answer?.words ?? "");
    this.modeChoice.set(this.photo !== null ? "photo" : this.panes[0].mode);
    this.said.replaceChildren(...model.sentences().map((line) => h("p", {}, line)));
    this.undoButton.disabled = !model.past.length;
    this.redoButton.disabled = !model.future.length;
    this.hurry();
  }

  // keys

  key(event) {
    if (this.help.open || event.target.matches("input[type=text], input[type=search], select")) return;
    const { model } = this;
    if (event.ctrlKey || event.metaKey) {
      const keys = { z: () => (event.shiftKey ? model.redo() : model.undo()), y: () => model.redo(), i: () => model.invert() };
      return this.run(keys[event.key.toLowerCase()], event);
    }
    const keys = {
      "?": () => this.help.showModal(), "/": () => this.search.input.focus(), f: () => this.fit(), m: () => this.nextMode(), p: () => this.togglePhoto(),
      "[": () => this.step(-1), "]": () => this.step(1), ",": () => this.sizeBrush(0.8), ".": () => this.sizeBrush(1.25),
      Delete: () => model.remove(), Backspace: () => model.remove(),
      Escape: () => (this.tools.tool === "move" ? model.clear() : this.setTool("move")),
    };
    Object.entries(TOOLS).forEach(([tool, [, key]]) => (keys[key] = () => this.setTool(tool)));
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (event.target.matches("input[type=range]") && key.startsWith("Arrow")) return;
    if (!this.run(keys[key], event) && this.tools.press(event)) event.preventDefault();
  }

  run(action, event) {
    if (!action) return false;
    event.preventDefault();
    action();
    return true;
  }

  sizeBrush(factor) {
    this.brushRadius = Math.min(Math.max(this.brushRadius * factor, BRUSH[0]), BRUSH[2]);
  }

  brushSize() {
    return this.brushRadius;
  }
}

const cloudName = (side) => (side === "color" ? "Colour cloud" : "Semantic field");
const helpList = () => h("dl", {}, ...HELP.flatMap(([keys, what]) => [h("dt", {}, keys), h("dd", {}, what)]));
