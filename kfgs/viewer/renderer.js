/**
 * Draws clouds of Gaussians with WebGL 2 by the rules of kfgs's rasteriser. Class, score and distance to the semantic cloud
 * are textures, so that gamma, lambda, hidden classes and modes change with a uniform and without Python.
 */
import {UNKNOWN, bufferOf, cloudsOf} from "./clouds.js";
import {bind, fill, frame, program, rectangles, row, sheet, solid, texture} from "./gl.js";
import {BATCH, COVERED, FINISH, PREPARE, SOLID_FRAGMENT, SOLID_VERTEX} from "./shaders.js";
import {SPLAT_FRAGMENT, SPLAT_VERTEX, WHOLE, WIDTH} from "./shaders.js";
import {startSorter} from "./sorter.js";

const MODES = ["color", "labels", "score", "latents"];
/** What a frame may leave out while the camera moves: size of the picture, alpha below which nothing is drawn (the
 * rasteriser's is 1/255), alpha at which a pixel is covered (1 - 1e-4), share of the Gaussians. */
const LEVELS = [
  {scale: 1, least: 1 / 255, enough: 0.9999, share: 1},
  {scale: 0.7, least: 1 / 100, enough: 0.98, share: 1},
  {scale: 0.5, least: 1 / 64, enough: 0.97, share: 1},
  {scale: 0.4, least: 1 / 40, enough: 0.95, share: 0.6},
  {scale: 0.4, least: 1 / 40, enough: 0.95, share: 0.3},
];
const FIRST = 3; // level of the first moving frame: a picture soon, on any machine
const SLOW = 90; // ms for a moving frame: then the next ones are smaller
const PIECES = 8; // parts of the order, between which covered pixels are found
const DOT = 1 / 110; // of the picture's height: the size of a point
const MARGIN = 1.1; // of the picture whose Gaussians are sorted, so that a turn shows no empty border
const LOOK = {
  mode: "color", scores: null, gamma: 0, lambda: 1, low: 0, high: 1, hidden: null, dim: true, mixing: 1,
  outline: [1, 0.85, 0.1],
};

/** The smallest float32 that is at least a number: no float32 tells between the two. */
function roundedUp(value) {
  const near = Math.fround(value);
  if (!(near < value)) return near;
  const bits = new Int32Array(new Float32Array([near]).buffer);
  bits[0]++; // of a positive number
  return new Float32Array(bits.buffer)[0];
}

/**
 * One canvas, up to two clouds. `side` is the cloud that is drawn next, `camera` the view: {viewmat: 16 numbers,
 * row-major, world to camera (x right, y down, z forward), fx, fy, cx, cy, width, height, near}; pixels of its own
 * picture, which is stretched to the viewport. A camera that changed is another object.
 */
export class Renderer {
  /**
   * Start WebGL on a canvas, and load a pack.
   * @param {HTMLCanvasElement} canvas
   * @param {{header: object, data: ArrayBuffer}} packed
   * @param {{clouds?: object, background?: number[], onlost?: function}} options clouds: those of the pack by side;
   *   background: red, green, blue in 0..1; onlost: called when the browser takes the graphics context away
   * @throws {Error} with a sentence for people
   */
  constructor(canvas, packed, {clouds = cloudsOf(packed), background = [1, 1, 1], onlost = null} = {}) {
    const gl = canvas.getContext("webgl2", {antialias: false, depth: false, alpha: false, preserveDrawingBuffer: true});
    if (!gl) {
      throw new Error("This browser has no WebGL 2. Switch on hardware acceleration in its settings, or try another browser.");
    }
    Object.assign(this, {canvas, gl, background, onorder: null});
    const float = gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float");
    this.format = float ? gl.RGBA16F : gl.RGBA8; // 8 bits cost accuracy, not more
    this.programs = {
      prepare: program(gl, WHOLE.replace("DEPTH", "0.0"), PREPARE),
      splat: program(gl, SPLAT_VERTEX, SPLAT_FRAGMENT),
      outlined: program(gl, SPLAT_VERTEX, SPLAT_FRAGMENT.replace("precision", "#define OUTLINE\nprecision")),
      solid: program(gl, SOLID_VERTEX, SOLID_FRAGMENT),
      covered: program(gl, WHOLE.replace("DEPTH", "-1.0"), COVERED),
      finish: program(gl, WHOLE.replace("DEPTH", "0.0"), FINISH),
    };
    this.empty = gl.createVertexArray();
    this.rectangles = rectangles(gl);
    this.sides = {};
    this.solids = [];
    this.camera = null;
    this.target = null;
    this.level = FIRST;
    this.loads = 0;
    this.waiting = [];
    this.sorter = startSorter((answer) => this.#sorted(answer));
    this.onlost = (event) => {
      event.preventDefault();
      onlost?.();
    };
    canvas.addEventListener("webglcontextlost", this.onlost);
    this.names = packed.header.classes;
    this.labelScores = bufferOf(packed, "semantic/label_scores");
    const labels = bufferOf(packed, "semantic/labels");
    const latents = bufferOf(packed, "semantic/latents");
    this.shared = {
      labels: sheet(gl, gl.R16I, labels.length, labels),
      scores: sheet(gl, gl.R32F, labels.length, null),
      latents: sheet(gl, gl.RGBA8, labels.length, latents),
      colormap: row(gl, bufferOf(packed, "colormap")),
      classes: row(gl, new Uint8Array(4 * (this.names.length + 1))),
    };
    Object.values(clouds).forEach((cloud) => this.#addSide(cloud));
    this.side = "color" in this.sides ? "color" : "semantic";
    this.look = {...LOOK};
    this.setLook({});
  }

  /** Change some of the options of `LOOK`. scores: of the question, one for each semantic Gaussian, or null. */
  setLook(changes) {
    this.look = {...this.look, ...changes};
    const {gl, look} = this;
    const groups = new Uint8Array(4 * (this.names.length + 1));
    const colors = [[128, 128, 128], ...this.names.map(({color}) => color)];
    colors.forEach((color, k) => {
      const hidden = look.hidden?.[k === 0 ? this.names.length : k - 1]; // the last is "no class"
      groups.set([...color, hidden ? 0 : 255], 4 * k);
    });
    gl.bindTexture(gl.TEXTURE_2D, this.shared.classes);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, colors.length, 1, gl.RGBA, gl.UNSIGNED_BYTE, groups);
    const scores = look.scores ?? this.labelScores;
    if (this.inTexture === scores) return;
    fill(gl, this.shared.scores, gl.R32F, scores.map((value) => (Number.isFinite(value) ? value : UNKNOWN)));
    this.inTexture = scores;
  }

  /** Draw these points and meshes with the clouds, see `solid` of gl.js. */
  setSolids(things) {
    this.solids.forEach(({made}) => this.gl.deleteVertexArray(made));
    this.solids = things.map((thing) => solid(this.gl, thing));
    this.#dropTarget(); // it has a picture of them, if there are any
  }

  /**
   * Show a cloud in place of the one of its side: send what is not the same array (see Cloud). `selected`: a mask of
   * Gaussians that are marked, instead of what the question selects; or null.
   */
  update(cloud, selected) {
    const state = this.sides[cloud.side];
    const {cloud: before, selected: marked} = state;
    Object.assign(state, {cloud, selected});
    if (before.source !== cloud.source) { // there are copies, or none any more
      const {side} = this;
      this.#dropSide(state);
      this.#addSide(cloud, selected);
      this.side = side;
      return;
    }
    if (before.splats !== cloud.splats) {
      fill(this.gl, state.textures.splats, this.gl.RGBA32UI, cloud.splats);
      this.#sendMeans(state);
    }
    if (before.dc !== cloud.dc) this.#showColors(state);
    if (before.removed !== cloud.removed || marked !== selected) this.#showMarks(state);
  }

  /**
   * Draw a frame of the current side with the last order, and ask the worker for one that fits the camera.
   * @param {object} viewport {x, y, width, height} in pixels of the canvas from its top left; all of it if missing. `clip`:
   *   the same for the part that is drawn. `moving`: the picture may be coarser, so that it keeps up with the mouse.
   */
  draw(viewport = {}) {
    const view = {x: 0, y: 0, width: this.canvas.width, height: this.canvas.height, ...viewport};
    const state = this.sides[this.side];
    this.#ask(state, view.moving ? LEVELS[this.level].share : 1);
    this.#render(state, view);
    this.#time(view.moving);
  }

  /** Wait until the order of what was drawn fits it: a frame drawn then is up to date. */
  async ordered() {
    const stale = () => Object.values(this.sides).some(({asked, fresh}) => asked && asked !== fresh);
    while (stale()) await new Promise((resolve) => this.waiting.push(resolve));
  }

  /** The cloud that is drawn, and the camera of its picture in a viewport: what pick.js works with. */
  seen({width, height} = this.canvas) {
    const {camera} = this;
    const [sx, sy] = [width / camera.width, height / camera.height];
    const own = {fx: camera.fx * sx, cx: camera.cx * sx, fy: camera.fy * sy, cy: camera.cy * sy, width, height};
    return {cloud: this.sides[this.side].cloud, camera: {...camera, ...own}};
  }

  /** Free the worker, and all graphics memory with the context. */
  dispose() {
    this.sorter.close();
    this.canvas.removeEventListener("webglcontextlost", this.onlost);
    this.gl.getExtension("WEBGL_lose_context")?.loseContext();
  }

  #addSide(cloud, selected = null) {
    const {gl} = this;
    const {count, planes} = cloud;
    const rows = Math.ceil(count / WIDTH);
    const shape = texture(gl, gl.RGBA32UI, WIDTH, rows);
    const paint = texture(gl, gl.RGBA32UI, WIDTH, rows);
    const textures = {
      splats: sheet(gl, gl.RGBA32UI, count, cloud.splats),
      dcs: sheet(gl, gl.R32UI, count, null),
      shs: texture(gl, gl.RG32UI, planes ? WIDTH : 1, Math.max(1, planes * rows)),
      marks: sheet(gl, gl.R8UI, count, null),
      fars: sheet(gl, gl.R32F, cloud.far ? count : 1, cloud.far),
      sources: sheet(gl, gl.R32I, cloud.far ? count : 1, cloud.source),
      order: sheet(gl, gl.R32UI, count, null),
    };
    const prepared = frame(gl, [shape, paint]);
    const state = {
      cloud, count, textures, rows, shape, paint, prepared, id: ++this.loads, selected,
      length: 0, asked: null, fresh: null, busy: false,
    };
    this.sides[cloud.side] = state;
    this.side = cloud.side;
    this.#sendMeans(state);
    this.#showColors(state);
    this.#showMarks(state);
  }

  #sendMeans(state) {
    const {side, means} = state.cloud;
    this.sorter.send({kind: "load", side, means, radii: state.cloud.radii()});
    state.asked = null; // sort again
  }

  #showColors({cloud, textures, rows}) {
    const {gl} = this;
    const {count, planes, dc, sh} = cloud;
    fill(gl, textures.dcs, gl.R32UI, dc);
    for (let t = 0; t < planes; t++) fill(gl, textures.shs, gl.RG32UI, sh.subarray(2 * t * count, 2 * (t + 1) * count), t * rows);
  }

  #showMarks({cloud: {removed}, selected, textures}) {
    fill(this.gl, textures.marks, this.gl.R8UI, removed.map((gone, i) => (selected?.[i] ? 1 : 0) | (gone << 1)));
  }

  /** Ask for an order that fits the camera, unless the last request was for it; one request at a time. */
  #ask(state, share) {
    if (state.asked?.camera === this.camera && state.asked.share === share) return;
    state.asked = {camera: this.camera, share};
    if (!state.busy) this.#send(state);
  }

  #send(state) {
    const {camera, share} = state.asked;
    const {fx, fy, cx, cy, width, height, near, viewmat} = camera;
    const grow = (low, high) => {
      const [middle, half] = [(low + high) / 2, (MARGIN * (high - low)) / 2];
      return [middle - half, middle + half];
    };
    const limits = [...grow(-cx / fx, (width - cx) / fx), ...grow(-cy / fy, (height - cy) / fy), 2 / Math.min(fx, fy)];
    state.busy = true;
    state.sent = state.asked;
    this.sorter.send({kind: "sort", side: state.cloud.side, load: state.id, share, view: viewmat, limits, near});
  }

  #sorted({side, load, order}) {
    const state = this.sides[side];
    if (!state || load !== state.id) return; // of what was loaded before
    state.busy = false;
    state.length = order.length;
    state.fresh = state.sent;
    fill(this.gl, state.textures.order, this.gl.R32UI, order);
    if (state.asked && state.asked !== state.fresh) this.#send(state);
    this.waiting.splice(0).forEach((resolve) => resolve());
    this.onorder?.(side);
  }

  #render(state, view) {
    const {gl, look} = this;
    const level = LEVELS[view.moving ? this.level : 0];
    const {scale} = level;
    const width = Math.max(1, Math.round(view.width * scale));
    const height = Math.max(1, Math.round(view.height * scale));
    const chosen = Boolean(look.outline) && (look.scores !== null || Boolean(state.selected));
    this.#fitTarget(width, height, chosen);
    this.#prepare(state, width, height);
    const {target} = this;
    const clip = view.clip ?? view;
    gl.bindFramebuffer(gl.FRAMEBUFFER, chosen ? target.both : target.one);
    gl.viewport(0, 0, width, height);
    gl.enable(gl.SCISSOR_TEST);
    const [left, below] = [(clip.x - view.x) * scale - 2, (view.y + view.height - clip.y - clip.height) * scale - 2];
    gl.scissor(Math.floor(left), Math.floor(below), Math.ceil(clip.width * scale) + 4, Math.ceil(clip.height * scale) + 4);
    gl.clearColor(0, 0, 0, 0);
    gl.clearDepth(1);
    gl.depthMask(true);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    if (this.solids.length) this.#solid(width, height, chosen);
    this.#splat(state, level, chosen);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    const bottom = this.canvas.height - view.y - view.height;
    gl.viewport(view.x, bottom, view.width, view.height);
    gl.scissor(clip.x, this.canvas.height - clip.y - clip.height, clip.width, clip.height);
    const {finish} = this.programs;
    gl.useProgram(finish.program);
    bind(gl, finish, {picture: target.picture, outline: target.outline, solids: target.solids});
    gl.uniform4f(finish.at.viewport, view.x, bottom, view.width, view.height);
    gl.uniform3fv(finish.at.paper, this.background);
    gl.uniform3fv(finish.at.rim, look.outline ?? [0, 0, 0]);
    gl.uniform1f(finish.at.width, chosen ? 1.5 : 0);
    gl.bindVertexArray(this.empty);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.disable(gl.SCISSOR_TEST);
  }

  /** Draw points and meshes into a picture of their own, with the depth buffer of the Gaussians. */
  #solid(width, height, chosen) {
    const {gl, camera, target} = this;
    const {at, program: used} = this.programs.solid;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.solid);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    gl.useProgram(used);
    this.#place(at, width, height);
    gl.uniform1f(at.dotSize, Math.max(2, DOT * height));
    for (const {made, points, corners} of this.solids) {
      gl.uniform1i(at.meshed, corners ? 1 : 0);
      gl.bindVertexArray(made);
      if (corners) gl.drawElements(gl.TRIANGLES, corners, gl.UNSIGNED_INT, 0);
      else gl.drawArrays(gl.POINTS, 0, points);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, chosen ? target.both : target.one);
  }

  /** The camera, for a program that draws a picture of this size. */
  #place(at, width, height) {
    const {gl} = this;
    const {viewmat, near, fx, fy, cx, cy} = this.seen({width, height}).camera;
    gl.uniformMatrix4fv(at.view, true, viewmat);
    gl.uniform4f(at.pinhole, fx, fy, cx, cy);
    gl.uniform2f(at.size, width, height);
    gl.uniform1f(at.near, near);
  }

  /** Compute the ellipse and the colour of every Gaussian in view. */
  #prepare(state, width, height) {
    const {gl, camera, look, shared} = this;
    const {prepare} = this.programs;
    const {cloud, textures} = state;
    const {at} = prepare;
    const {meta} = cloud;
    const m = camera.viewmat;
    gl.bindFramebuffer(gl.FRAMEBUFFER, state.prepared);
    gl.viewport(0, 0, WIDTH, Math.ceil(state.length / WIDTH));
    gl.disable(gl.BLEND);
    gl.disable(gl.DEPTH_TEST);
    gl.useProgram(prepare.program);
    bind(gl, prepare, {...textures, ...shared});
    gl.uniform1i(at.count, state.length);
    gl.uniform1i(at.rows, state.rows);
    gl.uniform1i(at.degree, cloud.planes ? meta.sh_degree : 0);
    gl.uniform1i(at.mode, MODES.indexOf(look.mode));
    gl.uniform1i(at.carried, cloud.source ? 1 : 0);
    gl.uniform1i(at.asked, look.scores === null ? 0 : 1);
    gl.uniform1i(at.masked, state.selected ? 1 : 0);
    gl.uniform1i(at.dim, look.dim ? 1 : 0);
    gl.uniform1i(at.antialiased, meta.antialiased ? 1 : 0);
    gl.uniform3fv(at.center, meta.center);
    gl.uniform3fv(at.spread, meta.half);
    gl.uniform2fv(at.scaling, meta.scale);
    gl.uniform2fv(at.dcScale, meta.dc);
    gl.uniform2f(at.scoreRange, look.low, look.high);
    gl.uniform1f(at.shStep, meta.sh_step);
    gl.uniform1f(at.gamma, look.gamma);
    gl.uniform1f(at.mixing, look.mixing);
    this.#place(at, width, height);
    gl.uniform1f(at.share, state.fresh?.share ?? 1);
    gl.uniform1f(at.lambda, roundedUp(look.lambda));
    gl.uniform3fv(at.eye, [0, 1, 2].map((k) => -(m[k] * m[3] + m[4 + k] * m[7] + m[8 + k] * m[11])));
    gl.uniform3fv(at.paper, this.background);
    gl.bindVertexArray(this.empty);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /** Blend the ellipses, nearest first, leaving out pixels that are covered already. */
  #splat(state, {least, enough}, chosen) {
    const {gl, target} = this;
    const used = chosen ? this.programs.outlined : this.programs.splat;
    const {covered} = this.programs;
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    gl.blendFunc(gl.ONE_MINUS_DST_ALPHA, gl.ONE);
    const piece = Math.ceil(state.length / PIECES);
    for (let from = 0; from < state.length; from += piece) {
      if (from > 0) {
        gl.bindFramebuffer(gl.FRAMEBUFFER, target.depthOnly);
        gl.useProgram(covered.program);
        bind(gl, covered, {picture: target.picture});
        gl.uniform1f(covered.at.enough, enough);
        gl.disable(gl.BLEND);
        gl.depthMask(true);
        gl.bindVertexArray(this.empty);
        gl.drawArrays(gl.TRIANGLES, 0, 3);
        gl.bindFramebuffer(gl.FRAMEBUFFER, chosen ? target.both : target.one);
      }
      gl.useProgram(used.program);
      bind(gl, used, {shapes: state.shape, paints: state.paint});
      gl.uniform2f(used.at.size, target.width, target.height);
      gl.uniform1f(used.at.least, least);
      gl.uniform1f(used.at.near, this.camera.near);
      gl.enable(gl.BLEND);
      gl.depthMask(false);
      const end = Math.min(from + piece, state.length);
      gl.uniform1i(used.at.first, from);
      gl.uniform1i(used.at.end, end);
      gl.bindVertexArray(this.rectangles);
      gl.drawElementsInstanced(gl.TRIANGLES, 6 * BATCH, gl.UNSIGNED_SHORT, 0, Math.ceil((end - from) / BATCH));
    }
    gl.disable(gl.BLEND);
    gl.disable(gl.DEPTH_TEST);
  }

  /** The picture that is blended into, of this size; with a second one for the outline if there is a selection. */
  #fitTarget(width, height, chosen) {
    const {gl} = this;
    const had = this.target;
    if (had && had.width === width && had.height === height && (had.both || !chosen)) return;
    this.#dropTarget();
    const picture = texture(gl, this.format, width, height, gl.LINEAR);
    const outline = texture(gl, gl.RGBA8, chosen ? width : 1, chosen ? height : 1, gl.LINEAR);
    const solids = texture(gl, gl.RGBA8, this.solids.length ? width : 1, this.solids.length ? height : 1, gl.LINEAR);
    const depth = gl.createRenderbuffer();
    gl.bindRenderbuffer(gl.RENDERBUFFER, depth);
    gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT24, width, height);
    this.target = {
      width, height, picture, outline, solids, depth, both: chosen ? frame(gl, [picture, outline], depth) : null,
      solid: this.solids.length ? frame(gl, [solids], depth) : null, one: frame(gl, [picture], depth),
      depthOnly: frame(gl, [], depth),
    };
  }

  #dropTarget() {
    const {gl, target} = this;
    if (!target) return;
    [target.picture, target.outline, target.solids].forEach((made) => gl.deleteTexture(made));
    [target.one, target.both, target.solid, target.depthOnly].forEach((made) => made && gl.deleteFramebuffer(made));
    gl.deleteRenderbuffer(target.depth);
    this.target = null;
  }

  /** Measure the time until the frame is drawn, and choose the size of the next moving frames by it. */
  #time(moving) {
    if (this.timing) return;
    const {gl} = this;
    const start = performance.now();
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    this.timing = true;
    const look = () => {
      if (gl.isContextLost()) return void (this.timing = false);
      const status = gl.clientWaitSync(fence, 0, 0);
      if (status === gl.TIMEOUT_EXPIRED) return void setTimeout(look, 2);
      gl.deleteSync(fence);
      this.timing = false;
      const took = performance.now() - start;
      if (!moving) {
        if (this.level < 3 && took > 4 * SLOW) this.level = 3;
      } else if (took > SLOW) {
        this.level = Math.min(this.level + 1, LEVELS.length - 1);
      } else if (took < 0.45 * SLOW) {
        this.level = Math.max(this.level - 1, 0);
      }
    };
    setTimeout(look, 0);
  }

  #dropSide({textures, shape, paint, prepared}) {
    const {gl} = this;
    [...Object.values(textures), shape, paint].forEach((made) => gl.deleteTexture(made));
    gl.deleteFramebuffer(prepared);
  }
}
