/** Building blocks of the interface: elements, icons, buttons, a slider with a histogram, a search box. */

const SVG = "http://www.w3.org/2000/svg";
const ICONS = {
  move: "M12 3v18M3 12h18M12 3l-3 3M12 3l3 3M12 21l-3-3M12 21l3-3M3 12l3-3M3 12l3 3M21 12l-3-3M21 12l-3 3",
  box: "M4 8V4h4M16 4h4v4M20 16v4h-4M8 20H4v-4M11 4h2M11 20h2M4 11v2M20 11v2",
  lasso: "M12 4c5 0 9 2.5 9 6s-4 6-9 6-9-2.5-9-6 4-6 9-6zM7 15.5c-1.5.5-2 3 0 3s2 2 0 3",
  brush: "M20 3l-9 10M11 13c-3 0-4 2-4 4s-2 3-4 3c3 2 10 2 10-3 0-2-1-3-2-4z",
  shift: "M4 12h7M8 9l-4 3 4 3M13 5h7v14h-7z",
  tape: "M3 16L16 3l5 5L8 21zM7 12l2 2M10 9l2 2M13 6l2 2",
  through: "M4 12h16M16 8l4 4-4 4M10 4v5M10 15v5",
  undo: "M9 6L4 11l5 5M4 11h10a6 6 0 010 12",
  redo: "M15 6l5 5-5 5M20 11H10a6 6 0 000 12",
  fit: "M4 9V4h5M20 9V4h-5M4 15v5h5M20 15v5h-5M12 12h.01",
  camera: "M4 8h4l2-3h4l2 3h4v11H4zM12 17a4 4 0 100-8 4 4 0 000 8z",
  theme: "M12 4a8 8 0 100 16zM12 4a8 8 0 010 16",
  help: "M9 9a3 3 0 116 0c0 2-3 2-3 5M12 18v.01",
  eye: "M2 12c4-8 16-8 20 0-4 8-16 8-20 0zM12 15a3 3 0 100-6 3 3 0 000 6z",
  hidden: "M2 12c4-8 16-8 20 0M4 20L20 4",
  solo: "M12 20a8 8 0 100-16 8 8 0 000 16zM12 14a2 2 0 100-4 2 2 0 000 4z",
  close: "M6 6l12 12M18 6L6 18",
  panel: "M4 5h16v14H4zM14 5v14",
};

/** An element: h("button", {class: "x", onclick: f, "aria-label": "y"}, "text", child). */
export function h(tag, props = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(props)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (name in made && name !== "list" && name !== "role") made[name] = value;
    else if (name === "class") made.className = value;
    else if (value !== null && value !== false) made.setAttribute(name, value);
  }
  made.append(...children.filter((child) => child !== null && child !== undefined));
  return made;
}

export function svg(tag, props, ...children) {
  const made = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(props)) made.setAttribute(name, value);
  made.append(...children);
  return made;
}

export const icon = (name) =>
  svg("svg", { viewBox: "0 0 24 24", class: "icon", "aria-hidden": "true" }, svg("path", { d: ICONS[name] }));

/** A button with an icon; the label is the tooltip and what a screen reader says. `key`: the shortcut to name. */
export function iconButton(name, label, onclick, { key = "", ...props } = {}) {
  const title = key ? `${label} (${key})` : label;
  return h("button", { type: "button", class: "tool", title, "aria-label": label, onclick, ...props }, icon(name));
}

export const textButton = (text, onclick, props = {}) => h("button", { type: "button", onclick, ...props }, text);

/** Buttons of which one is pressed. `choices`: [value, text, tooltip]. Returns {element, set(value)}. */
export function choice(label, choices, onpick) {
  const buttons = new Map();
  for (const [value, text, title = ""] of choices)
    buttons.set(value, textButton(text, () => onpick(value), { title, "aria-pressed": "false" }));
  return {
    element: h("div", { class: "choice", role: "group", "aria-label": label }, ...buttons.values()),
    set: (value) => buttons.forEach((made, own) => made.setAttribute("aria-pressed", String(own === value))),
  };
}

/** Show a list of choices in a <select>. */
export function select(label, choices, value, onpick) {
  const options = choices.map(([own, text]) => h("option", { value: own, selected: own === value }, text));
  return h("select", { "aria-label": label, onchange: (event) => onpick(event.target.value) }, ...options);
}

/**
 * A slider above its histogram, with a field to type the value.
 * @param {{label, id, toFraction(value), toValue(fraction), onvalue(value, dragging), above}} options `above`: the part
 *   of the histogram above the value is lit, else the part below
 */
export function histogramSlider({ label, id: name, toFraction, toValue, onvalue, above }) {
  const id = freeId(name);
  const [faint, lit] = [svg("path", {}), svg("path", {})];
  const frame = (path, name) => svg("svg", { viewBox: "0 0 64 1", preserveAspectRatio: "none", class: name }, path);
  const top = frame(lit, "lit");
  const range = h("input", { type: "range", id, min: 0, max: 1, step: "any", "aria-label": label });
  const field = h("input", { type: "text", inputMode: "decimal", "aria-label": `${label}, typed`, class: "number" });
  let dragging = false;
  let shown = ""; // in the field, unless somebody types
  range.addEventListener("input", () => {
    onvalue(toValue(Number(range.value)), dragging);
    dragging = true;
  });
  range.addEventListener("change", () => (dragging = false));
  field.addEventListener("change", () => {
    onvalue(parseFloat(field.value.replace(",", ".")), false);
    field.value = shown; // what was typed may be out of range, or no number
  });
  return {
    element: h(
      "div",
      { class: "slider" },
      h("label", { htmlFor: id }, label, field),
      h("div", { class: "bins", "aria-hidden": "true" }, frame(faint, "faint"), top),
      range,
    ),
    set(value, bins) {
      const place = Math.min(Math.max(toFraction(value), 0), 1);
      range.value = place;
      range.setAttribute("aria-valuetext", value.toPrecision(3));
      shown = Number(value.toPrecision(4));
      if (document.activeElement !== field) field.value = shown;
      const path = bars(bins);
      for (const one of [faint, lit]) one.setAttribute("d", path);
      top.style.clipPath = above ? `inset(0 0 0 ${100 * place}%)` : `inset(0 ${100 - 100 * place}% 0 0)`;
    },
  };
}

/** The outline of a histogram; heights grow with the root, so that small counts are seen. */
function bars(bins) {
  const most = Math.sqrt(bins.reduce((a, b) => Math.max(a, b), 1));
  const steps = [...bins].map((count, i) => `H${i}V${(1 - Math.sqrt(count) / most).toFixed(3)}H${i + 1}`);
  return `M0 1${steps.join("")}V1Z`;
}

/**
 * A text field with suggestions below it (a "combobox").
 * @param {{label, placeholder, suggest(text): string[], onchoose(text), onclear()}} options
 */
export function searchBox({ label, placeholder, suggest, describe, onchoose, onclear }) {
  const list = h("ul", { role: "listbox", id: freeId("kfgs-suggestions"), hidden: true, "aria-label": "Suggestions" });
  const input = h("input", {
    type: "text", id: freeId("query"), placeholder, autocomplete: "off", spellcheck: false, role: "combobox", maxLength: 200,
    "aria-label": label, "aria-autocomplete": "list", "aria-expanded": "false", "aria-controls": list.id,
  });
  const drop = iconButton("close", "Clear the search", () => clear(), { class: "tool drop", hidden: true });
  let at = -1;

  const close = () => {
    list.hidden = true;
    at = -1;
    input.setAttribute("aria-expanded", "false");
    input.removeAttribute("aria-activedescendant");
  };
  const choose = (text) => {
    close();
    input.value = text;
    if (text.trim()) onchoose(text);
    else onclear();
  };
  const clear = () => {
    close();
    input.value = "";
    onclear();
    input.focus();
  };
  const open = () => {
    const found = suggest(input.value);
    list.replaceChildren(...found.map((text, i) => option(text, i)));
    list.hidden = !found.length;
    input.setAttribute("aria-expanded", String(found.length > 0));
    at = -1;
  };
  const option = (text, i) => {
    const press = (event) => (event.preventDefault(), choose(text));
    const props = { role: "option", id: `${list.id}-${i}`, "aria-selected": "false", onpointerdown: press };
    return h("li", props, ...describe(text));
  };
  const move = (step) => {
    if (list.hidden) open();
    const count = list.children.length;
    if (!count) return;
    list.children[at]?.setAttribute("aria-selected", "false");
    at = (at + step + count + (at < 0 && step < 0 ? 1 : 0)) % count;
    list.children[at].setAttribute("aria-selected", "true");
    list.children[at].scrollIntoView({ block: "nearest" });
    input.setAttribute("aria-activedescendant", list.children[at].id);
  };
  const keys = {
    ArrowDown: () => move(1),
    ArrowUp: () => move(-1),
    Enter: () => choose(at >= 0 ? suggest(input.value)[at] : input.value),
    Escape: () => (list.hidden ? clear() : close()),
  };
  input.addEventListener("keydown", (event) => {
    event.stopPropagation(); // typed letters are no shortcuts
    if (keys[event.key]) {
      event.preventDefault();
      keys[event.key]();
    }
  });
  input.addEventListener("input", open);
  input.addEventListener("focus", open);
  input.addEventListener("click", open);
  input.addEventListener("blur", close);
  return {
    element: h("div", { class: "search" }, input, drop, list),
    input,
    set(words) {
      drop.hidden = !words;
      if (document.activeElement !== input || words) input.value = words;
    },
  };
}

/** Offer a file to the person. */
export function download(name, blob) {
  const link = h("a", { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

let taken = 0;

/** An id that no element has: two widgets may stand in one notebook. */
export function freeId(name) {
  return document.getElementById(name) ? `${name}-${++taken}` : name;
}
