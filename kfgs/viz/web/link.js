/** Who answers what the page cannot: in an exported file the packed scores; later the server or the notebook. */

import { bufferOf } from "./clouds.js";

const NEEDS_PYTHON =
  "Searching for any words needs Python: open the scene with “kfgs view” or in a notebook. This file knows its classes only";

/** Answers questions about classes from the scores in the pack. */
export class OfflineLink {
  constructor(packed) {
    this.packed = packed;
    this.names = Object.keys(packed.header.query); // the classes, and phrases that were asked before the file was written
    this.phrases = false; // whether it answers any words
  }

  /**
   * @param {string} words a class name, in any case
   * @returns {Promise<{words, number, scores, gamma, how, low, high}>} `scores` is NaN where nothing is known
   * @throws {Error} a sentence for people, if there is no such class
   */
  async ask(words) {
    const name = className(words, this.names);
    const found = this.packed.header.query[name];
    if (!found) throw new Error(explain(words, this.names));
    const number = Number(found.buffer.split("/")[1]);
    return { ...found, words: name, number, scores: bufferOf(this.packed, found.buffer) };
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

function explain(words, names) {
  const near = nearest(words.trim(), names);
  const hint = near ? `Did you mean “${near}”? ` : "";
  return `“${words.trim()}” is none of the classes. ${hint}${NEEDS_PYTHON}: ${listed(names)}.`;
}

function listed(names) {
  const more = names.length - 8;
  return names.slice(0, 8).join(", ") + (more > 0 ? ` and ${more} more` : "");
}

/** The class name with the most pairs of letters in common with the words; null if they have less than half. */
function nearest(words, names) {
  const pairs = (text) => new Set([...text.toLowerCase()].map((_, i) => text.toLowerCase().slice(i, i + 2)));
  const asked = pairs(words);
  const scored = names.map((name) => {
    const own = pairs(name);
    return [(2 * [...own].filter((pair) => asked.has(pair)).length) / (own.size + asked.size), name];
  });
  scored.sort((a, b) => b[0] - a[0]);
  return scored.length && scored[0][0] >= 0.5 ? scored[0][1] : null;
}
