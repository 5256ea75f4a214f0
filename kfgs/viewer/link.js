/** Who answers questions: in an exported file the packed scores, else Python behind a page or a notebook. */

import { bufferOf } from "./clouds.js";

const PATIENCE = 600_000; // milliseconds for an answer of a kernel, which may have other cells to run first
const NEEDS_PYTHON = "Any other words need Python: open the scene with “kfgs view” or in a notebook.";
const NEEDS_TEACHER = "Any other words need the teacher's text encoder: start “kfgs view” with --teacher.";

/** Answers questions about classes from the scores in the pack. */
export class OfflineLink {
  constructor(packed) {
    this.packed = packed;
    this.names = Object.keys(packed.header.query); // the classes, and phrases that were asked before the file was written
    this.phrases = false; // whether it answers any words
  }

  /**
   * @param {string} words a class name, in any case
   * @returns {Promise<{words, scores, gamma, how, low, high}>} `scores` is NaN where nothing is known
   * @throws {Error} a sentence for people, if there is no such class
   */
  async ask(words) {
    const name = className(words, this.names);
    const found = this.packed.header.query[name];
    if (!found) throw new Error(explain(words, this.names, NEEDS_PYTHON));
    return { ...found, words: name, scores: bufferOf(this.packed, found.buffer) };
  }

  /** The secret in the address of a page that shows a file of splats. */
  async openFile(file) {
    if (this.call !== callPage) throw new Error(`Only “kfgs view” opens files: run “kfgs view ${file.name}”.`);
    return (await this.call("open", { name: file.name }, file))[0].secret;
  }
}

/** The class that is meant: found exactly, then without regard to case if only one spelling fits; else null. */
export function className(words, names) {
  const wanted = words.trim();
  if (names.includes(wanted)) return wanted;
  const folded = [...new Set(names)].filter((name) => name.toLowerCase() === wanted.toLowerCase());
  return folded.length === 1 ? folded[0] : null;
}

/** Class names for what was typed so far: those that begin with it, then those that contain it. */
export function suggestions(typed, names) {
  const stem = typed.trim().toLowerCase();
  const unique = [...new Set(names)];
  const begins = unique.filter((name) => name.toLowerCase().startsWith(stem));
  return [...begins, ...unique.filter((name) => !begins.includes(name) && name.toLowerCase().includes(stem))];
}

function explain(words, names, needs) {
  const more = names.length > 8 ? ` and ${names.length - 8} more` : "";
  return `“${words.trim()}” is none of the classes (${names.slice(0, 8).join(", ")}${more}). ${needs}`;
}

/** Answers from Python what the pack does not: session.py at the other end of a page's address or of a notebook's kernel. */
export class PythonLink extends OfflineLink {
  /**
   * @param {(name: string, args: object, ...attached: BlobPart[]) => Promise<[object, ArrayBuffer]>} call `callPage`, or
   *   what `callWidget` gives
   * @param {{header: object, data: ArrayBuffer}} packed its header says whether Python answers any words
   */
  constructor(call, packed) {
    super(packed);
    Object.assign(this, { call, phrases: packed.header.phrases, python: true });
  }

  /** As `OfflineLink.ask`, for any words if Python has the teacher's text encoder. */
  async ask(words) {
    if (className(words, this.names) !== null) return super.ask(words);
    if (!this.phrases) throw new Error(explain(words, this.names, NEEDS_TEACHER));
    const [answer, scores] = await this.call("ask", { words });
    return { ...answer, scores: new Float32Array(scores) };
  }

  /** An answer for what is like some semantic Gaussians, a mask; as `ask`. */
  async similar(mask) {
    const [answer, scores] = await this.call("similar", {}, bitsOf(mask));
    return { ...answer, example: true, scores: new Float32Array(scores) };
  }

  /** Connected parts of a mask: {parts: [{count, corners}], numbers: Int16Array}, the largest first; -1: of no part. */
  async parts(side, mask, edits) {
    const [answer, numbers] = await this.call("parts", { side, edits: { [side]: edits } }, bitsOf(mask));
    return { ...answer, numbers: new Int16Array(numbers) };
  }

  /** Write the selected Gaussians of some sides into Python's folder; returns the paths. `edits`: of each side, see Model.editsOf. */
  async saveSelection({ words, gamma, lambda, edits, masks }) {
    const args = { words, gamma, lambda, edits, sides: Object.keys(masks) };
    return (await this.call("save_selection", args, ...Object.values(masks).map(bitsOf)))[0].paths;
  }

  /** Write the edited splats, and the edits as JSON. */
  async saveEdits(edits, lambda) {
    return (await this.call("save_edits", { edits, lambda }))[0].paths;
  }
}

/** Call Python over the page's own address; see server.py for the form of a message. */
export async function callPage(name, args, ...attached) {
  const text = new TextEncoder().encode(JSON.stringify({ name, args }));
  const body = new Blob([new Uint32Array([text.length]), text, ...attached]);
  const sent = await fetch("call", { method: "POST", body }).catch(() => null);
  if (!sent) throw new Error("Python does not answer: has “kfgs view” ended?");
  if (!sent.ok) throw new Error(`Python refused this (${sent.status}). Reload the page, or select fewer Gaussians.`);
  return checked(readMessage(await sent.arrayBuffer()));
}

/** What `callPage` is, for a widget of a notebook: `model` is anywidget's. */
export function callWidget(model) {
  const waiting = new Map();
  const view = Math.random(); // a widget that is shown twice hears the answers of both
  let last = 0;
  model.on("msg:custom", (message, buffers) => {
    const answered = waiting.get(message.id);
    waiting.delete(message.id);
    answered?.([message.answer, buffers[0] ? plain(buffers[0]) : new ArrayBuffer(0)]);
  });
  return async (name, args, ...attached) => {
    const id = `${view} ${++last}`;
    const answered = new Promise((resolve, reject) => {
      waiting.set(id, resolve);
      setTimeout(() => waiting.delete(id) && reject(new Error("Python does not answer: is the kernel busy, or has it ended?")), PATIENCE);
    });
    model.send({ id, name, args }, undefined, attached);
    return checked(await answered);
  };
}

/** The parts of an answer: [object, ArrayBuffer]. */
export function readMessage(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const text = new TextDecoder().decode(new Uint8Array(buffer, 4, length));
  return [JSON.parse(text), buffer.slice(4 + length)];
}

function checked([answer, attached]) {
  if (answer.error) throw new Error(answer.error);
  return [answer, attached];
}

/** A mask with one bit for each Gaussian, the lowest first. */
export function bitsOf(mask) {
  const bits = new Uint8Array(Math.ceil(mask.length / 8));
  for (let i = 0; i < mask.length; i++) bits[i >> 3] |= (mask[i] ? 1 : 0) << (i & 7);
  return bits;
}

/** An ArrayBuffer of its own from a DataView or a typed array. */
function plain(view) {
  return view.buffer.slice(view.byteOffset, view.byteOffset + view.byteLength);
}
