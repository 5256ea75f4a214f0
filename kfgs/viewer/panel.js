/** The panel beside the view: search result, lambda, classes, selection and edits, the picked Gaussian. */

import { freeId, h, histogramSlider, iconButton, textButton } from "./dom.js";
import { SIDE_WORDS, short, whole } from "./model.js";

const MANY = 12; // classes from which on the list has a filter
const css = (rgb) => `rgb(${rgb.join(",")})`;

/**
 * Build the panel. `act`: {ask(words), fit(), duplicate(), save(), open(file)}, and with Python {similar(), split(), saveSelection(), saveEdits()}.
 * Returns {element, refresh()}.
 */
export function makePanel(model, act) {
  const carried = model.carried ? [lambdaPart(model)] : [];
  const shown = [scorePart(model), partsPart(model, act), pickPart(model), selectionPart(model, act), classesPart(model, act), ...carried];
  return {
    element: h("aside", { class: "panel", "aria-label": "Search, classes and selection" }, ...shown.map((one) => one.element)),
    refresh: () => shown.forEach((one) => one.refresh()),
  };
}

const section = (title, ...children) => h("section", {}, h("h2", {}, title), ...children);

function scorePart(model) {
  const slider = histogramSlider({
    label: "Gamma (score to exceed)", id: "gamma", above: true,
    toFraction: (value) => (value - model.answer.low) / (model.answer.high - model.answer.low),
    toValue: (place) => model.answer.low + place * (model.answer.high - model.answer.low),
    onvalue: (value, dragging) => model.setGamma(value, dragging),
  });
  const title = h("h2");
  const note = h("p", { class: "note" });
  const element = h("section", { hidden: true }, title, slider.element, note);
  const refresh = () => {
    element.hidden = !model.answer;
    if (!model.answer) return;
    title.textContent = `Search: ${model.answer.words}`;
    slider.set(model.gamma, model.gammaHistogram());
    const { gamma, how } = model.answer;
    note.textContent = `${model.now.gammaHow === "given" ? "Suggested was" : "Suggested:"} ${short(gamma)} (${how})`;
  };
  return { element, refresh };
}

function lambdaPart(model) {
  const [low, span] = model.lambdaSpan();
  const slider = histogramSlider({
    label: "Lambda (reach of labels)", id: "lambda", above: false,
    toFraction: (value) => (Math.log(value) - low) / span,
    toValue: (place) => Math.exp(low + place * span),
    onvalue: (value) => model.setLambda(value),
  });
  const said = h("p", { id: freeId("lambda-said") });
  const element = section("Labels of the colour cloud", slider.element, said);
  const refresh = () => {
    slider.set(model.lambda, model.lambdaHistogram());
    said.textContent = model.lambdaSentence();
  };
  return { element, refresh };
}

function classesPart(model, act) {
  const present = new Set(model.own);
  const labels = [...model.names.keys()].filter((label) => present.has(label));
  if (model.carried || present.has(-1)) labels.push(-1);
  const rows = labels.map((label) => classRow(model, label, act));
  const list = h("ul", { class: "classes" }, ...rows.map((row) => row.element));
  const all = textButton("Show all", () => model.setHidden([]), { class: "link" });
  const filter = h("input", {
    type: "search", class: "filter", placeholder: "Filter classes", "aria-label": "Filter classes", hidden: labels.length <= MANY,
    oninput: () => rows.forEach((row) => (row.element.hidden = !fits(row.name))),
  });
  const fits = (name) => name.toLowerCase().includes(filter.value.trim().toLowerCase());
  const element = section("Classes", all, filter, list);
  const refresh = () => {
    const counts = model.counts(model.side);
    rows.forEach((row) => row.refresh(counts));
    element.hidden = !model.names.length;
    all.hidden = !model.hidden.size;
  };
  return { element, refresh };
}

function classRow(model, label, act) {
  const name = model.names[label] ?? "no class";
  const color = model.packed.header.classes[label]?.color ?? [128, 128, 128];
  const count = h("span", { class: "count" });
  const solo = iconButton("solo", `Show only ${name}`, () => model.solo(label));
  const eye = h("button", { type: "button", class: "tool eye", onclick: () => model.toggleHidden(label) });
  const [open, shut] = [iconButton("eye", "").firstChild, iconButton("hidden", "").firstChild];
  const search = () => textButton(name, () => act.ask(name), { class: "name", title: `Search for ${name}` });
  const words = label >= 0 ? search() : h("span", { class: "name" }, name);
  const swatch = h("span", { class: "swatch", style: `background:${css(color)}` });
  const element = h("li", { "data-label": label }, swatch, words, count, solo, eye);
  const refresh = (counts) => {
    const hidden = model.hidden.has(label);
    count.textContent = whole(label < 0 ? counts.none : counts.classes[label]);
    element.classList.toggle("off", hidden);
    element.classList.toggle("asked", model.answer?.words === name);
    eye.replaceChildren(hidden ? shut : open);
    eye.title = `${hidden ? "Show" : "Hide"} ${name}`;
    eye.setAttribute("aria-label", eye.title);
    eye.setAttribute("aria-pressed", String(hidden));
    solo.setAttribute("aria-pressed", String(model.isSolo(label)));
  };
  return { element, name, refresh };
}

function selectionPart(model, act) {
  const said = h("p", { id: freeId("selection-said") });
  const button = (text, title, run, props = {}) => textButton(text, run, { title, ...props });
  const change = [
    button("Invert", "Select everything else (Ctrl+I)", () => model.invert()),
    button("Fit", "Move the camera to the selection (F)", act.fit),
    button("Clear", "Select nothing (Escape)", () => model.clear()),
  ];
  const paint = () => model.recolor(hex(color.value).map((value) => value / 255));
  const color = h("input", { type: "color", value: "#c04040", "aria-label": "New colour", onchange: paint });
  const fade = () => model.fade(opacity.value / 100);
  const opacity = h("input", { type: "range", min: 0, max: 100, value: 100, "aria-label": "Opacity", onchange: fade });
  const recolor = h("label", { class: "pair", title: "Give the selection a colour, and keep its shading" }, "Recolour", color);
  const edits = [
    button("Remove", "Remove the selected Gaussians (Delete)", () => model.remove(), { class: "danger" }),
    button("Duplicate", "Add a copy of the selected Gaussians beside them; move it with tool 5", act.duplicate),
    recolor,
    h("label", { class: "pair", title: "Make the selection transparent" }, "Opacity", opacity),
  ];
  const save = button("Save state", "Save question, selection and edits as JSON, to open again", act.save);
  const file = h("input", { type: "file", accept: ".json,application/json", hidden: true, "aria-label": "State to open" });
  file.addEventListener("change", () => (act.open(file.files[0]), (file.value = "")));
  const open = button("Open state", "Open a state that was saved", () => file.click());
  const files = act.saveSelection ? [
    button("Save Gaussians", "Write the selected Gaussians as PLY files, and their parts", act.saveSelection),
    button("Save edited scene", "Write the scene with its edits, and the edits as JSON", act.saveEdits),
  ] : [];
  if (act.similar) change.push(button("Similar", "Search for what is like the selection", act.similar));
  if (act.split) change.push(button("Parts", "List the connected parts of the selection: chair 1, chair 2", act.split));
  const boxes = h("div", {}, h("div", { class: "buttons" }, ...change), h("div", { class: "buttons" }, ...edits));
  const element = section("Selection", said, boxes, h("div", { class: "buttons" }, ...files, save, open, file));
  const refresh = () => {
    const count = model.counts(model.side).selected;
    const other = model.sides.find((side) => side !== model.side && model.counts(side).selected > 0);
    boxes.hidden = !count && !other;
    save.hidden = boxes.hidden && !model.edited;
    if (files.length) [files[0].hidden, files[1].hidden] = [boxes.hidden, !model.edited];
    recolor.hidden = !model.sides.some((side) => model.clouds[side].colored && model.counts(side).selected);
    if (model.now.what !== "opacity") opacity.value = 100;
    const more = other ? `, and ${whole(model.counts(other).selected)} ${SIDE_WORDS[other]} ones` : "";
    said.textContent = boxes.hidden
      ? `${model.names.length ? "Search for a class, or select" : "Select"} with the box, the lasso or the brush.`
      : `${whole(count)} ${model.kindOf(model.side)}s${more}`;
  };
  return { element, refresh };
}

function partsPart(model, act) {
  const list = h("ul", { class: "classes" });
  const element = section("Connected parts", textButton("Close", () => model.setParts(null), { class: "link" }), list);
  let shown = null;
  const refresh = () => {
    element.hidden = !model.parts;
    if (!model.parts || model.parts === shown) return;
    shown = model.parts;
    const { name, parts } = shown;
    const choose = (number) => () => (model.selectPart(number), act.fit());
    const row = ({ count }, at) =>
      h("li", {}, textButton(`${name} ${at + 1}`, choose(at), { class: "name", title: "Select this part" }), h("span", { class: "count" }, whole(count)));
    list.replaceChildren(...parts.map(row));
    element.scrollIntoView({ block: "nearest" });
  };
  return { element, refresh };
}

function pickPart(model) {
  const body = h("div", { class: "picked", "aria-live": "polite" });
  const element = section("Picked Gaussian", iconButton("close", "Unpick", () => model.pick(model.side, -1)), body);
  const refresh = () => {
    const found = model.describe();
    element.hidden = !found;
    if (found) body.replaceChildren(...pickLines(model, found));
  };
  return { element, refresh };
}

function pickLines(model, found) {
  const color = model.packed.header.classes[found.label]?.color ?? [128, 128, 128];
  const { origin } = model.packed.header;
  const place = model.position(found.side, found.index).map((x, axis) => x + origin[axis]);
  const at = place.map((x) => (Math.abs(x) < 10000 ? short(x) : x.toFixed(2))).join(", ");
  const score = Number.isFinite(found.score) ? `, score ${found.score.toFixed(3)}` : "";
  const lines = [
    h("p", {}, h("span", { class: "swatch", style: `background:${css(color)}` }), h("strong", {}, found.name), score),
    h("p", { class: "note" }, `${model.kindOf(found.side)} ${found.index} at ${at}`),
  ];
  if (found.distance !== null) {
    const away = found.distance > 0 ? `${short(found.distance)} away` : "in the same place";
    const reach = found.reached ? "Its label is from" : "Out of reach: the nearest labelled one is";
    lines.push(h("p", { class: "note" }, `${reach} semantic Gaussian ${found.source}, ${away}`));
  }
  return lines;
}

const hex = (text) => [1, 3, 5].map((at) => parseInt(text.slice(at, at + 2), 16));
