/** The viewer's state and rules: question, gamma, lambda, hidden classes, selection, edits, undo. Uses no DOM. */

import { bufferOf, cloudsOf } from "./clouds.js";
import { bitsOf } from "./link.js";

const MOST_UNDONE = 50; // steps
const MOST_KEPT = 2e7; // Gaussians in all steps: a step keeps up to 80 bytes of each
const BINS = 64; // of the histograms
const NOTHING = { answer: null, gamma: null, gammaHow: "", hand: {} }; // asked or selected
export const SIDE_WORDS = { color: "colour", semantic: "semantic" };

/** A whole number with separators: 100,000. */
export const whole = (value) => Math.round(value).toLocaleString("en-US");

/** A number with about three digits. */
export const short = (value) => (Number.isFinite(value) ? String(Number(value.toPrecision(3))) : "unknown");

export class Model extends EventTarget {
  /**
   * @param {{header: object, data: ArrayBuffer}} packed see kfgs/viewer/pack.py
   */
  constructor(packed) {
    super();
    const { header } = packed;
    this.packed = packed;
    this.names = header.classes.map((one) => one.name);
    this.sides = ["color", "semantic"].filter((side) => header.sides[side]);
    this.side = this.sides[0];
    this.original = cloudsOf(packed);
    this.answers = 0; // so far
    this.own = bufferOf(packed, "semantic/labels");
    this.ownScores = bufferOf(packed, "semantic/label_scores");
    this.lambda = header.lambda ? header.lambda.value : Infinity;
    this.hidden = new Set();
    this.picked = null; // {side, index}
    this.tape = []; // up to two places [x, y, z]
    this.parts = null; // {side, name, parts, numbers}
    this.now = { ...NOTHING, edits: [], clouds: this.original, what: "", id: 0 };
    this.past = [];
    this.future = [];
    this.cache = new Map();
  }

  /** Number of Gaussians of a side, removed ones and copies included. */
  total(side) {
    return this.clouds[side].count;
  }

  /** What a Gaussian of a side is called. */
  kindOf(side) {
    return this.sides.length > 1 ? `${SIDE_WORDS[side]} Gaussian` : "Gaussian";
  }

  /** Whether labels reach the colour cloud from the semantic one. */
  get carried() {
    return this.packed.header.buffers["color/source"] !== undefined;
  }

  /** Both sides as the edits made them. */
  get clouds() {
    return this.now.clouds;
  }

  get answer() {
    return this.now.answer;
  }

  /** The words of the question; null if there is none, or it was asked by an example ("like the selection"). */
  get words() {
    return this.answer && !this.answer.example ? this.answer.words : null;
  }

  get gamma() {
    return this.now.gamma;
  }

  /** Whether anything can be shown as selected: a question, or a selection by hand. */
  get selecting() {
    return this.answer !== null || this.byHand;
  }

  get byHand() {
    return Object.keys(this.now.hand).length > 0;
  }

  /** Show connected parts of the selection of a side, see `PythonLink.parts`; null hides them. */
  setParts(found) {
    this.parts = found && { ...found, cloud: this.clouds[found.side] };
    this.changed();
  }

  /** Select one connected part alone. */
  selectPart(number) {
    const { side, numbers } = this.parts;
    this.select(side, Uint8Array.from(numbers, (own) => (own === number ? 1 : 0)));
  }

  /** Show the answer to a question (see link.js); null clears it. The selection is then the question's. */
  ask(answer) {
    this.parts = null;
    this.step(answer ? `search for ${answer.words}` : "clear the search", this.answered(answer));
  }

  /** The question and its suggested gamma, as a part of the state. */
  answered(answer) {
    if (!answer) return NOTHING;
    answer.id ??= ++this.answers;
    return { answer, gamma: answer.gamma, gammaHow: answer.how, hand: {} };
  }

  /** Select Gaussians that score above gamma; steps of one drag of a slider are one step of undo. */
  setGamma(gamma, dragging = false) {
    if (!this.answer || !Number.isFinite(gamma)) return;
    const { low, high } = this.answer;
    const value = Math.min(Math.max(gamma, low), high);
    this.step("change gamma", { gamma: value, gammaHow: "given", hand: {} }, dragging);
  }

  setLambda(lambda) {
    const given = this.packed.header.lambda.value;
    const value = lambda === given ? given : Math.fround(lambda); // distances are rounded for these: rounded_far in pack.py
    if (!(value > 0)) return;
    this.lambda = value;
    this.changed();
  }

  /** Hide these labels (-1: no class), show all others. */
  setHidden(labels) {
    this.hidden = new Set(labels);
    this.changed();
  }

  toggleHidden(label) {
    const hidden = new Set(this.hidden);
    if (!hidden.delete(label)) hidden.add(label);
    this.setHidden(hidden);
  }

  /** Show one class alone; a second call shows all. */
  solo(label) {
    const others = [-1, ...this.names.keys()].filter((one) => one !== label);
    this.setHidden(this.isSolo(label) ? [] : others);
  }

  isSolo(label) {
    return !this.hidden.has(label) && this.hidden.size === this.names.length;
  }

  /** Labels of a side, -1 = none. A colour Gaussian takes its source's label if that is closer than lambda. */
  labels(side) {
    return this.cached(`labels ${this.key(side)}`, () => this.carry(side, this.own, -1, Int16Array));
  }

  /** Scores of the question, or of the labels without a question; NaN where unknown. */
  scores(side) {
    return this.carry(side, this.answer ? this.answer.scores : this.ownScores, NaN, Float32Array);
  }

  /** What the question selects on a side, hidden, removed or not; the comparison is Python's, in float32. */
  questioned(side) {
    if (!this.answer) return new Uint8Array(this.total(side));
    const gamma = Math.fround(this.gamma);
    const make = () => {
      const own = Uint8Array.from(this.answer.scores, (score) => (score > gamma ? 1 : 0));
      return this.carry(side, own, 0, Uint8Array);
    };
    return this.cached(`selected ${this.answer.id} ${gamma} ${this.key(side)}`, make);
  }

  /** Selected Gaussians that are not removed, Uint8Array; the same array while nothing changes. */
  selected(side) {
    return this.cached(`chosen ${this.now.id} ${this.key(side)}`, () => {
      const mask = this.byHand ? this.now.hand[side] ?? new Uint8Array(this.total(side)) : this.questioned(side);
      const { removed } = this.clouds[side];
      return mask.map((on, i) => on & ~removed[i] & 1);
    });
  }

  /** Gaussians that are neither hidden nor removed. */
  drawn(side) {
    return this.cached(`drawn ${[...this.hidden]} ${this.key(side)}`, () => {
      const { removed } = this.clouds[side];
      return Uint8Array.from(this.labels(side), (label, i) => (this.hidden.has(label) || removed[i] ? 0 : 1));
    });
  }

  /** Counts of a side, without removed Gaussians: {total, selected, removed, classes: [..], none}. */
  counts(side) {
    const key = `counts ${side} ${this.lambda} ${this.now.id}`;
    return this.cached(key, () => {
      const labels = this.labels(side);
      const { removed } = this.clouds[side];
      const classes = new Array(this.names.length).fill(0);
      const found = { total: 0, selected: sum(this.selected(side)), removed: sum(removed), none: 0, classes };
      for (let i = 0; i < labels.length; i++) {
        if (removed[i]) continue;
        found.total += 1;
        if (labels[i] < 0) found.none += 1;
        else classes[labels[i]] += 1;
      }
      return found;
    });
  }

  /**
   * Change the selection by hand: replace (only this side stays selected), add or subtract. Hidden Gaussians are not
   * selected. With `joins`, further parts of one brush stroke are one step of undo.
   */
  select(side, mask, how = "replace", joins = false) {
    const drawn = this.drawn(side);
    const old = this.selected(side);
    const rules = {
      replace: (i) => mask[i] & drawn[i],
      add: (i) => old[i] | (mask[i] & drawn[i]),
      subtract: (i) => old[i] & ~(mask[i] & drawn[i]),
    };
    const made = old.map((_, i) => rules[how](i));
    this.step("select", { hand: how === "replace" ? { [side]: made } : { ...this.bySides(), [side]: made } }, joins);
  }

  /** The semantic Gaussians that are selected, or that give the selected colour Gaussians their class: a mask of the pack's. */
  meant() {
    const made = new Uint8Array(this.own.length);
    for (const side of this.sides) {
      const { source, far } = this.clouds[side];
      for (const i of indices(this.selected(side))) if (!source || far[i] < this.lambda) made[source ? source[i] : i] = 1;
    }
    return made;
  }

  /** Select everything that is not selected now, on the side shown. */
  invert(side = this.side) {
    const drawn = this.drawn(side);
    this.step("invert selection", { hand: { [side]: this.selected(side).map((on, i) => (on ? 0 : drawn[i])) } });
  }

  /** Drop the question and the selection by hand. */
  clear() {
    if (this.selecting) this.step("clear selection", NOTHING);
  }

  /** Remove the selected Gaussians of both sides; the selection ends. Returns how many. */
  remove() {
    return this.edit("remove", {}, NOTHING);
  }

  /** Give the selected Gaussians a colour, [r, g, b] in 0..1, and keep their shading. Returns how many. */
  recolor(rgb) {
    return this.edit("recolor", { rgb });
  }

  /** Multiply the opacity of the selected Gaussians by a factor, 0..1; again, while they are selected, replaces it. */
  fade(factor) {
    return this.edit("opacity", { factor }, {}, (last) => ({ ...last, factor }));
  }

  /** Move the selected Gaussians by a vector; with `joins`, further parts of one drag are one step of undo. */
  move(translation, joins = false) {
    const add = (last) => ({ ...last, translation: last.translation.map((value, axis) => value + translation[axis]) });
    return this.edit("move", { translation }, {}, joins ? add : null);
  }

  /** Add copies of the selected Gaussians, moved by a vector; the copies are selected then. */
  duplicate(translation) {
    const rows = this.chosen();
    const hand = Object.entries(rows).map(([side, { length }]) => {
      const count = this.total(side);
      return [side, new Uint8Array(count + length).fill(1, count)];
    });
    return this.edit("duplicate", { translation }, { ...NOTHING, hand: Object.fromEntries(hand) });
  }

  /**
   * An edit of the selected Gaussians, as kfgs.labels.edits has it.
   * @param {function?} join makes one of the last edit and this one, if that was of the same Gaussians
   */
  edit(op, values, change = {}, join = null) {
    const rows = this.chosen((cloud) => op !== "recolor" || cloud.colored);
    const count = Object.values(rows).reduce((all, own) => all + own.length, 0);
    if (!count) return 0;
    const { edits, what } = this.now;
    const last = edits.at(-1);
    const joins = join !== null && what === op && sameRows(last.rows, rows);
    const before = joins ? this.past.at(-1) : this.now;
    const made = joins ? join(last) : { op, rows, ...values };
    this.step(op, { edits: [...before.edits, made], clouds: after(before.clouds, made), ...change }, joins);
    return count;
  }

  /** The numbers of the selected Gaussians of each side that has some. */
  chosen(allowed = () => true) {
    const sides = this.sides.filter((side) => allowed(this.clouds[side]));
    const found = sides.map((side) => [side, indices(this.selected(side))]);
    return Object.fromEntries(found.filter(([, rows]) => rows.length));
  }

  get edited() {
    return this.now.edits.length > 0;
  }

  undo() {
    if (!this.past.length) return;
    this.future.push(this.now);
    this.now = this.past.pop();
    this.changed();
  }

  redo() {
    if (!this.future.length) return;
    this.past.push(this.now);
    this.now = this.future.pop();
    this.changed();
  }

  /** Pick a Gaussian; index < 0 picks nothing. */
  pick(side, index) {
    this.picked = index >= 0 ? { side, index } : null;
    this.changed();
  }

  /** Put an end of the measuring tape to a place; a third one begins anew, null takes the tape away. */
  measure(place) {
    this.tape = place ? [...(this.tape.length === 1 ? this.tape : []), place] : [];
    this.changed();
  }

  /** The length of the tape in world units; null without its two ends. */
  get length() {
    const [from, to] = this.tape;
    return to ? Math.hypot(...from.map((value, axis) => to[axis] - value)) : null;
  }

  /**
   * What is known about a Gaussian, the picked one by default; null if there is none, or it is hidden or removed. `distance` is that to the
   * nearest labelled one.
   */
  describe({ side, index } = this.picked ?? { index: -1 }) {
    if (index < 0) return null;
    const label = this.labels(side)[index];
    const { source: sources, far, removed } = this.clouds[side];
    if (label === undefined || this.hidden.has(label) || removed[index]) return null;
    const source = sources ? sources[index] : index;
    const reached = !far || far[index] < this.lambda;
    const own = this.answer ? this.answer.scores : this.ownScores;
    const score = reached && source >= 0 ? own[source] : NaN;
    const distance = side === "color" && source >= 0 ? far[index] : null;
    return { side, index, label, name: this.names[label] ?? "no class", score, source, distance, reached };
  }

  /** Where a Gaussian is, [x, y, z]. */
  position(side, index) {
    return [...this.clouds[side].means.subarray(3 * index, 3 * index + 3)];
  }

  /** Middle and radius of the selected Gaussians of a side, or of all that are drawn; outliers do not count. */
  extent(side) {
    const chosen = this.selected(side);
    const mask = sum(chosen) ? chosen : this.drawn(side);
    const count = sum(mask);
    const points = this.clouds[side].means;
    const axes = [0, 1, 2].map((axis) => {
      const own = new Float32Array(count);
      for (let i = 0, k = 0; i < mask.length; i++) if (mask[i]) own[k++] = points[3 * i + axis];
      own.sort(); // as numbers: it is a typed array
      return [own[Math.floor(0.02 * own.length)], own[Math.floor(0.98 * (own.length - 1))]];
    });
    if (axes[0][0] === undefined) return null;
    const radius = Math.hypot(...axes.map(([low, high]) => (high - low) / 2));
    return { center: axes.map(([low, high]) => (low + high) / 2), radius: Math.max(radius, 1e-3) };
  }

  /** The state as JSON. Edits have the form of kfgs.labels.EditList; their order is kept, but removals come last. */
  toJSON() {
    const asked = { words: this.words, gamma: this.gamma, lambda: this.carried ? this.lambda : null };
    const sides = this.sides.map((side) => {
      const count = this.packed.header.sides[side].count;
      const selected = this.byHand || this.answer?.example ? textOf(this.selected(side)) : null;
      return [side, { count, selected, edits: this.editsOf(side) }];
    });
    const { side, picked, tape } = this;
    const shown = { hidden: [...this.hidden].sort((a, b) => a - b), side, picked, tape };
    return { format: "kfgs.view", version: 1, ...asked, ...shown, sides: Object.fromEntries(sides) };
  }

  /** The edits of one side as JSON. Removals come last, so that the numbers in all others are those of the viewer. */
  editsOf(side) {
    const own = this.now.edits.filter(({ rows }) => side in rows);
    const gone = own.filter(({ op }) => op === "remove").flatMap(({ rows }) => [...rows[side]]);
    const where = (numbers) => ({ kind: "index", indices: numbers });
    const kept = own.filter(({ op }) => op !== "remove").map(({ rows, ...edit }) => ({ ...edit, where: where([...rows[side]]) }));
    return gone.length ? [...kept, { op: "remove", where: where(gone) }] : kept;
  }

  /**
   * Become what `toJSON` gave; one step of undo, except for what `arrange` does.
   * @param {object} saved
   * @param {object?} answer to the question that was saved
   * @throws {Error} a sentence for people, if it is of another scene, or somebody changed it into what cannot be done
   */
  fromJSON(saved, answer) {
    if (saved?.format !== "kfgs.view" || saved.version !== 1) {
      const what = saved?.format === "kfgs.edits" ? "has the edits of one cloud, for “kfgs edit --replay”" : "is no state of the viewer";
      throw new Error(`This file ${what}. Choose the file that “Save state” downloaded, kfgs_view.json.`);
    }
    const other = this.sides.find((side) => saved.sides?.[side]?.count !== this.packed.header.sides[side].count);
    if (other) {
      const [count, own] = [saved.sides?.[other]?.count ?? 0, this.packed.header.sides[other].count];
      throw new Error(`This state is of another scene, with ${whole(count)} ${SIDE_WORDS[other]} Gaussians; here are ${whole(own)}.`);
    }
    const [edits, hand] = [[], {}];
    for (const side of this.sides) {
      let { count, selected, edits: own } = saved.sides[side];
      for (const { where, ...edit } of own) {
        if (!possible(edit, where?.indices, count)) throw new Error(`This state has an edit that cannot be done: ${JSON.stringify(edit)}.`);
        edits.push({ ...edit, rows: { [side]: Uint32Array.from(where.indices) } });
        if (edit.op === "duplicate") count += where.indices.length;
      }
      if (selected) hand[side] = maskOf(selected, count);
    }
    const given = answer && Number.isFinite(saved.gamma) && saved.gamma !== answer.gamma;
    this.step("open", { ...this.answered(answer), ...(given ? { gamma: saved.gamma, gammaHow: "given" } : {}), hand, edits, clouds: edits.reduce(after, this.original) });
    this.arrange(saved);
  }

  /** Take over what is no step of undo: hidden classes, the side shown, the picked Gaussian, the tape, lambda. */
  arrange({ hidden, side, picked, tape, lambda }) {
    this.hidden = new Set([hidden ?? []].flat());
    if (this.sides.includes(side)) this.side = side;
    this.picked = this.sides.includes(picked?.side) ? picked : null;
    this.tape = [tape ?? []].flat().filter((place) => place?.length === 3 && place.every?.(Number.isFinite));
    this.setLambda(Number(lambda ?? this.lambda));
  }

  /** Counts of the question's scores in bins from `low` to `high`. */
  gammaHistogram() {
    const { id, scores, low, high } = this.answer;
    return this.cached(`gamma bins ${id}`, () => bins(scores, (score) => (score - low) / (high - low)));
  }

  /** Counts of the distances to the nearest labelled Gaussian, in bins of the logarithm. */
  lambdaHistogram() {
    const [low, span] = this.lambdaSpan();
    return this.cached("lambda bins", () => bins(bufferOf(this.packed, "color/far"), (far) => (Math.log(Math.max(far, 1e-30)) - low) / span));
  }

  /** Logarithm of the smallest lambda, and the width of its range. */
  lambdaSpan() {
    const { low, high } = this.packed.header.lambda;
    return [Math.log(low), Math.max(Math.log(high / low), 1e-6)];
  }

  /** The state in sentences, for people. */
  sentences() {
    const lines = [];
    const counts = this.counts(this.side);
    const kind = `${this.kindOf(this.side)}s`;
    const some = `${whole(counts.selected)} of ${whole(counts.total)} ${kind}`;
    if (this.byHand) lines.push(`${some} are selected by hand.`);
    else if (this.answer) lines.push(`${some} score above ${short(this.gamma)} for “${this.answer.words}”.`);
    else lines.push(`${whole(counts.total)} ${kind}.`);
    const seen = this.hidden.size ? this.drawn(this.side) : null;
    const hidden = seen ? counts.selected - sum(this.selected(this.side).map((on, i) => on & seen[i])) : 0;
    if (hidden) lines.push(`${whole(hidden)} of these are hidden, and change with the others.`);
    if (counts.removed) lines.push(`${whole(counts.removed)} are removed.`);
    if (this.length !== null) lines.push(`The tape is ${short(this.length)} world units long.`);
    return lines;
  }

  /** How many colour Gaussians have no label at this lambda, in a sentence. */
  lambdaSentence() {
    const { none, total } = this.counts("color");
    const far = `farther than ${short(this.lambda)} from any labelled one`;
    return `${whole(none)} of ${whole(total)} Gaussians are ${far}, so they have no class.`;
  }

  // private

  step(what, change, joins = false) {
    const last = this.now;
    if (!(joins && last.what === what)) {
      this.past.push(last);
      const total = this.sides.reduce((all, side) => all + this.total(side), 0);
      if (this.past.length > Math.min(MOST_UNDONE, MOST_KEPT / total)) this.past.shift();
    }
    this.future = [];
    this.now = { ...last, ...change, what, id: (this.steps = (this.steps ?? 0) + 1) };
    this.changed();
  }

  changed() {
    const { cloud, side } = this.parts ?? {};
    if (cloud && ["means", "removed"].some((name) => cloud[name] !== this.clouds[side][name])) this.parts = null;
    this.dispatchEvent(new Event("change"));
  }

  bySides() {
    return Object.fromEntries(this.sides.map((side) => [side, this.selected(side)]));
  }

  /** What labels and masks of a side depend on. */
  key(side) {
    return `${this.clouds[side].id} ${side === "color" ? this.lambda : ""}`;
  }

  /** Values of the semantic Gaussians for all Gaussians of a side. */
  carry(side, values, nothing, Kind) {
    const { source, far, count } = this.clouds[side];
    if (!source) return values;
    const made = new Kind(count).fill(nothing);
    for (let i = 0; i < count; i++) if (far[i] < this.lambda) made[i] = values[source[i]];
    return made;
  }

  cached(key, make) {
    if (!this.cache.has(key)) {
      if (this.cache.size > 30) this.cache.delete(this.cache.keys().next().value);
      this.cache.set(key, make());
    }
    return this.cache.get(key);
  }
}

/** The clouds of both sides after an edit. */
const after = (clouds, edit) => Object.fromEntries(Object.entries(clouds).map(([side, cloud]) => [side, cloud.edited(edit)]));

/** Sum of a mask: how many are set. */
export function sum(mask) {
  let count = 0;
  for (let i = 0; i < mask.length; i++) count += mask[i];
  return count;
}

/** The numbers of what a mask has, Uint32Array. */
const indices = (mask) => Uint32Array.from(mask.keys()).filter((i) => mask[i]);

/** A mask as text: its bits (see link.js) in base64. */
const textOf = (mask) => btoa(Array.from(bitsOf(mask), (byte) => String.fromCharCode(byte)).join(""));

/** The mask of so many Gaussians that `textOf` gave; older files have the numbers of those that are set. */
function maskOf(saved, count) {
  const made = new Uint8Array(count);
  if (Array.isArray(saved)) for (const i of saved) made[i] = 1;
  else {
    const bits = atob(saved);
    for (let i = 0; i < Math.min(count, 8 * bits.length); i++) made[i] = (bits.charCodeAt(i >> 3) >> (i & 7)) & 1;
  }
  return made;
}

/** Whether an edit that was read can be done to these Gaussians of so many. */
function possible({ op, factor, rgb, translation }, rows, count) {
  const within = (values, low, high) => Array.isArray(values) && values.every((one) => Number.isFinite(one) && one >= low && one <= high);
  const vector = (values, low, high) => within(values, low, high) && values.length === 3;
  const values = {
    remove: () => true, opacity: () => within([factor], 0, 1), recolor: () => vector(rgb, 0, 1),
    move: () => vector(translation, -Infinity, Infinity), duplicate: () => vector(translation, -Infinity, Infinity),
  };
  return within(rows, 0, count - 1) && (values[op]?.() ?? false);
}

function sameRows(a, b) {
  const same = (p, q) => p?.length === q.length && p.every((row, k) => row === q[k]);
  return Object.keys(a).length === Object.keys(b).length && Object.keys(b).every((side) => same(a[side], b[side]));
}

function bins(values, place) {
  const made = new Float64Array(BINS);
  for (let i = 0; i < values.length; i++) {
    const at = Math.floor(BINS * place(values[i]));
    if (at >= 0) made[Math.min(at, BINS - 1)] += Number.isFinite(values[i]) ? 1 : 0;
  }
  return made;
}
