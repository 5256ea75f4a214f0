/** Reads the pack: buffers, positions, shapes, classes and scores of the Gaussians, with the rules that Python has; edits them. */

import { luminance, tint, weightedMedian } from "./tint.js";

const MEAN_STEPS = 2 ** 21 - 1;
const ARRAYS = { float32: Float32Array, uint32: Uint32Array, int32: Int32Array, int16: Int16Array, uint8: Uint8Array };
/** Instead of NaN in textures: graphics cards may compare NaN as they like. */
export const UNKNOWN = -3e38;

/**
 * A buffer of the pack as a typed array, or null.
 * @param {{header: object, data: ArrayBuffer}} packed
 * @param {string} name
 */
export function bufferOf(packed, name) {
  const entry = packed.header.buffers[name];
  if (!entry) return null;
  const kind = ARRAYS[entry.type];
  return new kind(packed.data, entry.offset, entry.length / kind.BYTES_PER_ELEMENT);
}

/**
 * The data of a pack from its compressed form.
 * @param {Uint8Array} bytes a zlib stream (Packed.compressed), in which the bytes of a buffer are sorted by their place in a row
 * @param {object} header of the pack
 * @returns {Promise<ArrayBuffer>}
 */
export async function inflate(bytes, header) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  const sorted = new Uint8Array(await new Response(stream).arrayBuffer());
  const data = sorted.slice();
  for (const {offset, length, type, shape} of Object.values(header.buffers)) {
    const width = ARRAYS[type].BYTES_PER_ELEMENT * (shape.length > 1 ? shape.at(-1) : 1);
    const rows = length / width;
    if (width === 1) continue;
    for (let place = 0; place < width; place++) {
      const from = offset + place * rows;
      for (let row = 0, to = offset + place; row < rows; row++, to += width) data[to] = sorted[from + row];
    }
  }
  return data.buffer;
}

let made = 0;

/** The clouds of a pack by side. */
export const cloudsOf = (packed) => Object.fromEntries(Object.keys(packed.header.sides).map((side) => [side, new Cloud(packed, side)]));

/**
 * One cloud of the pack, or what an edit made of it. Arrays are indexed by Gaussian, as in Python; copies come after the
 * originals. Nothing changes a cloud: `edited` gives another one, which shares every array that the edit does not change.
 */
export class Cloud {
  constructor(packed, side) {
    const own = (name) => bufferOf(packed, `${side}/${name}`);
    this.id = ++made;
    this.side = side;
    this.meta = packed.header.sides[side];
    this.count = this.meta.count;
    this.splats = own("splats");
    this.dc = own("dc");
    this.sh = own("sh");
    this.planes = this.sh ? this.sh.length / 2 / this.count : 0;
    this.source = side === "color" ? own("source") : null; // the semantic Gaussian that gives the class; null: itself
    this.far = side === "color" ? own("far") : null; // its distance
    this.means = this.#decodeMeans();
    this.removed = new Uint8Array(this.count);
    this.reach = null; // of pick.js
  }

  /** Whether its colours can be changed: it has its own. */
  get colored() {
    return this.meta.sh_degree !== null;
  }

  /** The cloud after an edit: {op, rows: {side: Uint32Array}, rgb?, factor?, translation?}; see Model.edit. */
  edited({ op, rows, ...values }) {
    const own = rows[this.side];
    if (!own) return this;
    const cloud = Object.assign(Object.create(Cloud.prototype), this, { id: ++made });
    EDITS[op](cloud, own, values);
    return cloud;
  }

  /** The opacity of Gaussian i. */
  opacityOf(i) {
    return (this.splats[4 * i + 3] >>> 24) / 255;
  }

  /** The three standard deviations of Gaussian i. */
  scalesOf(i) {
    const word = this.splats[4 * i + 3];
    const [low, step] = this.meta.scale;
    return [0, 8, 16].map((shift) => Math.exp(low + step * ((word >>> shift) & 255)));
  }

  /** The unit quaternion (w, x, y, z) of Gaussian i. */
  quatOf(i) {
    const word = this.splats[4 * i + 2];
    const small = [0, 10, 20].map((shift) => (((word >>> shift) & 1023) / 1023 - 0.5) * Math.SQRT2);
    const rest = Math.sqrt(Math.max(0, 1 - small.reduce((sum, v) => sum + v * v, 0)));
    small.splice(word >>> 30, 0, rest);
    return small;
  }

  /** For each Gaussian, the largest distance from its mean at which it may be seen; negative where it never is. */
  radii() {
    const radii = new Float32Array(this.count);
    for (let i = 0; i < this.count; i++) {
      const word = this.splats[4 * i + 3];
      const opacity = word >>> 24;
      const [low, step] = this.meta.scale;
      const largest = Math.max(word & 255, (word >>> 8) & 255, (word >>> 16) & 255);
      radii[i] = opacity > 1 ? Math.sqrt(2 * Math.log(opacity)) * Math.exp(low + step * largest) * 1.001 : -1;
    }
    return radii;
  }

  #decodeMeans() {
    const {center, half} = this.meta;
    const means = new Float32Array(3 * this.count);
    const open = (whole, axis) => {
      const v = (4 * whole) / MEAN_STEPS - 2;
      const u = Math.abs(v) <= 1 ? v : Math.sign(v) / Math.max(2 - Math.abs(v), 1e-6);
      return center[axis] + half[axis] * u;
    };
    for (let i = 0; i < this.count; i++) {
      const a = this.splats[4 * i], b = this.splats[4 * i + 1];
      means[3 * i] = open(a & 0x1fffff, 0);
      means[3 * i + 1] = open((a >>> 21) | ((b & 1023) << 11), 1);
      means[3 * i + 2] = open((b >>> 10) & 0x1fffff, 2);
    }
    return means;
  }
}

// Edits of a cloud that nobody else has yet: each replaces the arrays that it changes.

const EDITS = {
  remove(cloud, rows) {
    renew(cloud, "removed");
    for (const i of rows) cloud.removed[i] = 1;
  },
  opacity(cloud, rows, { factor }) {
    renew(cloud, "splats");
    for (const i of rows) {
      const word = cloud.splats[4 * i + 3];
      cloud.splats[4 * i + 3] = (word & 0xffffff) | (Math.round((word >>> 24) * factor) << 24);
    }
    cloud.reach = null; // see pick.js
  },
  move(cloud, rows, { translation }) {
    renew(cloud, "splats", "means");
    shift(cloud, rows, translation);
  },
  duplicate(cloud, rows, { translation }) {
    shift(cloud, append(cloud, rows), translation);
  },
  recolor(cloud, rows, { rgb }) {
    renew(cloud, "dc", "sh");
    paint(cloud, rows, rgb);
  },
};

function renew(cloud, ...names) {
  for (const name of names) cloud[name] = cloud[name]?.slice() ?? null;
}

/** Append copies; returns their numbers. */
function append(cloud, rows) {
  const { count, planes, sh } = cloud;
  cloud.source ??= Int32Array.from({ length: count }, (_, i) => i);
  cloud.far ??= new Float32Array(count); // its own class, at any lambda
  for (const [name, width] of [["splats", 4], ["dc", 1], ["means", 3], ["removed", 1], ["source", 1], ["far", 1]])
    cloud[name] = withRows(cloud[name], rows, width);
  cloud.count += rows.length;
  if (sh) {
    cloud.sh = new sh.constructor(2 * planes * cloud.count);
    for (let t = 0; t < planes; t++)
      cloud.sh.set(withRows(sh.subarray(2 * t * count, 2 * (t + 1) * count), rows, 2), 2 * t * cloud.count);
  }
  cloud.reach = null;
  return Uint32Array.from(rows, (_, k) => count + k);
}

function shift({ meta, means, splats }, rows, translation) {
  for (const i of rows) {
    const [x, y, z] = translation.map((step, axis) => {
      means[3 * i + axis] += step;
      const u = (means[3 * i + axis] - meta.center[axis]) / meta.half[axis];
      const v = Math.abs(u) <= 1 ? u : (2 - 1 / Math.abs(u)) * Math.sign(u);
      return Math.round(((v + 2) / 4) * MEAN_STEPS);
    });
    splats[4 * i] = x | (y << 21);
    splats[4 * i + 1] = (y >>> 11) | (z << 10);
  }
}

/** Give Gaussians one hue and keep their shading: `Recolor` of kfgs. */
function paint(cloud, rows, rgb) {
  const [low, step] = cloud.meta.dc;
  const colors = Array.from(rows, (i) => [0, 10, 20].map((bits) => low + step * ((cloud.dc[i] >>> bits) & 1023)));
  const lights = Float64Array.from(colors, luminance);
  const sizes = Float64Array.from(rows, (i) => {
    const sides = cloud.scalesOf(i).sort((a, b) => b - a);
    return cloud.opacityOf(i) * sides[0] * sides[1];
  });
  const shade = tint(rgb, weightedMedian(lights, sizes));
  const bytes = cloud.sh && new Int8Array(cloud.sh.buffer);
  rows.forEach((i, k) => {
    const [color, slopes] = shade(lights[k]);
    const [r, g, b] = color.map((value) => Math.min(Math.max(Math.round((value - low) / step), 0), 1023));
    cloud.dc[i] = r | (g << 10) | (b << 20);
    for (let first = 0; first < 8 * cloud.planes - 2; first += 3) {
      const at = [first, first + 1, first + 2].map((j) => 8 * ((j >> 3) * cloud.count + i) + (j & 7));
      const light = luminance(at.map((place) => bytes[place]));
      at.forEach((place, axis) => (bytes[place] = Math.min(Math.max(Math.round(slopes[axis] * light), -127), 127)));
    }
  });
}

/** Rows of an array, with some of them once more at its end. */
function withRows(values, rows, width) {
  const made = new values.constructor(values.length + width * rows.length);
  made.set(values);
  rows.forEach((row, k) => made.set(values.subarray(width * row, width * (row + 1)), values.length + width * k));
  return made;
}
