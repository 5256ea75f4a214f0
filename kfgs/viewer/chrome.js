/** The elements around the view: bar, tools, captions, the scene's views, photo, help. `app` is app.js's App. */

import { choice, h, iconButton, searchBox, select, textButton } from "./dom.js";
import { suggestions } from "./link.js";
import { whole } from "./model.js";

export const TOOLS = {
  move: ["Move the view", "1"], box: ["Box selection", "2"], lasso: ["Lasso selection", "3"], brush: ["Brush selection", "4"],
  shift: ["Move the selected Gaussians (Shift: up and down)", "5"], tape: ["Measure: click two places", "6"],
};
const HOWS = [
  ["replace", "=", "Select anew"], ["add", "+", "Add to the selection (Shift)"], ["subtract", "−", "Subtract from the selection (Alt)"],
];
const MEANINGS = {
  color: "The scene as photographed", labels: "The class of each Gaussian", latents: "The features as colours: what is alike has one colour",
  score: "How well each Gaussian fits the search, or its class: dark to bright",
};
const LAYOUTS = [["one", "One view"], ["split", "Side by side"], ["slider", "Slider"]];
const HELP = [
  ["Drag", "turn the view; inside a room: look around"], ["Right drag, Shift + drag", "move it sideways"], ["Middle drag, Ctrl + drag", "look around"], ["Wheel, two fingers, + −", "zoom"],
  ["W A S D, Q E", "fly (Shift: faster)"], ["Click", "pick a Gaussian"], ["Double click", "turn about this point"],
  ["F", "fit the selection, or the first view"], ["R, Shift + R", "another axis is up, turn the picture by 5 degrees"], ["[ ]", "previous and next photo view"], ["P", "photo over the view"],
  ["/", "search"], ["M", "next colour mode"], ["1 2 3 4", "move, box, lasso, brush"], [", .", "smaller and larger brush"],
  ["5", "drag the selection (Shift: up and down)"], ["6", "measure: click two places"],
  ["Shift or Alt + tool", "add to or subtract from the selection"], ["X", "select through: also what others hide"], ["Delete", "remove the selection"],
  ["Ctrl + I", "invert the selection"], ["Ctrl + Z, Ctrl + Shift + Z", "undo, redo"],
  ["Escape", "move tool, then clear the selection"], ["Drop a file", "open a splat (kfgs view), or a saved state"],
];

/** The bar at the top. Returns {element, refresh()}. */
export function makeTop(app) {
  const { model, link, header } = app;
  const present = new Set(model.own);
  const names = model.names.filter((_, label) => present.has(label));
  const count = (name) => whole(model.counts(model.side).classes[model.names.indexOf(name)]);
  const what = link.phrases ? "Search for anything" : "Search for a class";
  const search = searchBox({
    label: what, placeholder: what, onchoose: (words) => app.ask(meant(words)), onclear: () => app.ask(null),
    suggest: (text) => suggestions(text === model.answer?.words ? "" : text, names),
    describe: (name) => [h("span", {}, name), h("small", {}, count(name))],
  });
  search.element.hidden = !names.length && !link.phrases;
  const meant = (words) => {
    const found = link.phrases ? [] : suggestions(words, names);
    return found.length === 1 ? found[0] : words; // the only class that the typed letters can become
  };
  const modes = Object.entries(app.modes).map(([mode, text]) => [mode, text, `${MEANINGS[mode]} (M)`]);
  const photos = header.cameras.some((camera) => camera.thumbnail);
  if (photos) modes.unshift(["photo", "Photo", "Lay the photo of the nearest view over the scene (P)"]);
  const mode = choice("Colours", modes, (own) => (own === "photo" ? app.togglePhoto() : app.setMode(own)));
  const layout = select("Views", LAYOUTS, "one", (own) => app.setLayout(own));
  const undo = iconButton("undo", "Undo", () => model.undo(), { key: "Ctrl+Z" });
  const redo = iconButton("redo", "Redo", () => model.redo(), { key: "Ctrl+Shift+Z" });
  const buttons = [
    undo, redo, iconButton("camera", "Save a picture", () => app.savePicture()),
    iconButton("theme", "Dark or light", () => app.setTheme(app.theme === "dark" ? "light" : "dark")),
    iconButton("help", "Keys and mouse", () => app.help.showModal(), { key: "?" }),
    iconButton("panel", "Show or hide the panel", () => app.root.classList.toggle("no-panel")),
  ];
  const title = h("h1", {}, header.title || "kfgs");
  const refresh = () => {
    search.set(model.answer?.words ?? "");
    mode.set(app.photo === null ? app.panes.list[0].mode : "photo");
    layout.value = app.panes.layout;
    undo.disabled = !model.past.length;
    redo.disabled = !model.future.length;
  };
  const element = h("header", { class: "top" }, title, search.element, mode.element, layout, h("span", { class: "tools" }, ...buttons));
  return { element, refresh, search };
}

/** The tools at the left edge. Returns {element, set(tool)}. */
export function makeRail(app) {
  const make = ([tool, [label, key]]) => iconButton(tool, label, () => app.setTool(tool), { key, "data-tool": tool });
  const buttons = Object.entries(TOOLS).map(make);
  const how = choice("What a selection does", HOWS, (own) => {
    app.tools.how = own;
    how.set(own);
  });
  how.set("replace");
  const fit = iconButton("fit", "Fit the selection, or go to the first view", () => app.fit(), { key: "F" });
  const through = iconButton("through", "Select through: also what others hide", () => app.setThrough(!app.through), { key: "X" });
  const set = (tool) => {
    buttons.forEach((one) => one.setAttribute("aria-pressed", String(one.dataset.tool === tool)));
    how.element.hidden = through.hidden = ["move", "shift", "tape"].includes(tool);
    through.setAttribute("aria-pressed", String(app.through));
  };
  set("move");
  return { element: h("div", { class: "rail card", role: "toolbar", "aria-label": "Tools" }, ...buttons, fit, how.element, through), set };
}

/** What each pane shows, at its upper edge, and the border between two. Returns {element, refresh()}. */
export function makeCaptions(app) {
  const { panes, model } = app;
  const line = h("span", { class: "line" });
  const slide = () => app.setSlider(Number(divider.value));
  const divider = h("input", {
    type: "range", class: "divider", min: 0, max: 1, step: 0.005, "aria-label": "Border between the two pictures", oninput: slide,
  });
  const element = h("div", { class: "captions" });
  const caption = (pane, at) => {
    const change = (changes) => (Object.assign(pane, changes), app.refreshPanes());
    const alone = panes.list.length === 1;
    const one = model.sides.length < 2;
    if (alone && one) return [];
    if (alone) return [select("Cloud", model.sides.map((side) => [side, cloudName(side)]), pane.side, (side) => change({ side }))];
    const choices = model.sides.flatMap((side) =>
      Object.entries(app.modes).map(([mode, text]) => [`${side} ${mode}`, one ? text : `${cloudName(side)}: ${text.toLowerCase()}`]));
    const set = (value) => change({ side: value.split(" ")[0], mode: value.split(" ")[1] });
    return [select(`View ${at + 1}`, choices, `${pane.side} ${pane.mode}`, set)];
  };
  const place = () => {
    divider.value = panes.slider;
    line.style.left = `${100 * (panes.layout === "slider" ? panes.slider : 0.5)}%`;
  };
  const refresh = () => {
    element.className = `captions ${panes.layout}`;
    line.hidden = panes.layout === "one";
    divider.hidden = panes.layout !== "slider";
    element.replaceChildren(...panes.list.flatMap(caption), line, divider);
    place();
  };
  return { element, refresh, place };
}

const cloudName = (side) => (side === "color" ? "Colour cloud" : "Semantic field");

/** Buttons that go to the scene's cameras, with their thumbnails; one of them is reached by Tab. Returns {element, set(at)}. */
export function makeViews(app) {
  const buttons = app.header.cameras.map((camera, at) => {
    const [url, label] = [app.thumbnail(at), `Go to ${camera.name || `view ${at + 1}`}`];
    const width = Math.max(36, Math.round((48 * camera.width) / camera.height)); // known before the picture is loaded: see `set`
    const content = url ? h("img", { src: url, alt: "", loading: "lazy", width }) : String(at + 1);
    return h("button", { type: "button", title: label, "aria-label": label, onclick: () => app.goTo(at) }, content);
  });
  const scroll = (event) => (event.currentTarget.scrollLeft += event.deltaY);
  const group = { class: "views card", role: "group", "aria-label": "The scene's views", hidden: !buttons.length, onwheel: scroll };
  const element = h("div", group, ...buttons);
  const set = (at) => {
    buttons.forEach((button, own) => {
      button.setAttribute("aria-current", String(own === at));
      button.tabIndex = own === (at ?? 0) ? 0 : -1;
    });
    if (buttons[at]) element.scrollLeft = buttons[at].offsetLeft - element.offsetLeft - element.offsetWidth / 2; // alone: not the page
  };
  set(null);
  return { element, set };
}

/** The photo of a view over the scene, with its opacity. Returns {elements, show(url)}. */
export function makePhoto() {
  const image = h("img", { class: "photo", alt: "", hidden: true });
  const fade = (event) => (image.style.opacity = event.target.value);
  const range = h("input", { type: "range", min: 0, max: 1, step: 0.01, value: 1, "aria-label": "Opacity of the photo", oninput: fade });
  const label = h("label", { class: "pair card photo-opacity", hidden: true }, "Photo", range);
  return {
    elements: [image, label],
    show(url) {
      image.hidden = label.hidden = !url;
      if (url) image.src = url;
    },
  };
}

/** The dialog with the keys. */
export function makeHelp() {
  const list = h("dl", {}, ...HELP.flatMap(([keys, what]) => [h("dt", {}, keys), h("dd", {}, what)]));
  const close = textButton("Close", () => dialog.close());
  const dialog = h("dialog", { class: "help", "aria-label": "Keys" }, h("h2", {}, "Keys and mouse"), list, close);
  return dialog;
}
