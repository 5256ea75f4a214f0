/** Starts the viewer in a page, a file or a notebook's widget, and keeps a widget and Python (shared.py) alike. */

import { mount } from "./app.js";
import { inflate } from "./clouds.js";
import { OfflineLink, PythonLink, callPage, callWidget, readMessage } from "./link.js";

const PAUSE = 150; // milliseconds after the last picture, before Python is told

/** Show the scene that a page (page.html) holds; if it holds none, ask the Python that served it. */
export async function startPage(root) {
  try {
    const held = document.getElementById("data");
    const header = held && JSON.parse(document.getElementById("header").textContent);
    root.textContent = "Loading the scene…";
    const packed = held ? { header, data: await unpack(held, header) } : await fetchPack();
    window.viewer = await mount(root, packed, held ? new OfflineLink(packed) : new PythonLink(callPage, packed));
  } catch (error) {
    if (!root.childElementCount) root.textContent = `This scene cannot be shown: ${error.message}`;
  }
}

function unpack(held, header) {
  held.remove();
  return inflate(Uint8Array.from(atob(held.textContent), (letter) => letter.charCodeAt(0)), header);
}

async function fetchPack() {
  const loaded = await fetch("pack").catch(() => null);
  if (!loaded?.ok) throw new Error("Python does not answer; its terminal says why.");
  const [header, data] = readMessage(await loaded.arrayBuffer());
  return { header, data };
}

/** What anywidget calls to show a widget in a notebook; returns what it calls at the end. */
export async function startWidget({ model, el }) {
  const root = document.createElement("div");
  root.style.height = `${model.get("height")}px`;
  root.dataset.lmSuppressShortcuts = "true"; // JupyterLab's keys would act on cells
  el.append(root);
  const [header, raw] = [model.get("header"), model.get("data")];
  const packed = { header, data: await inflate(new Uint8Array(raw.buffer, raw.byteOffset, raw.byteLength), header) };
  const app = await mount(root, packed, new PythonLink(callWidget(model), packed));
  const end = await share(app, model);
  return () => (end(), app.dispose());
}

/**
 * Share a viewer with anywidget's model, and show what Python set before there was a viewer. Returns a function that ends it.
 * @param {App} app see app.js
 * @param {object} widget has `wire`, in the form of `Model.toJSON`, and `view`, a camera as in the pack
 */
async function share(app, widget) {
  const { model } = app;
  const parts = { wire: () => model.toJSON(), view: () => app.panes.lens() };
  const told = Object.fromEntries(Object.entries(parts).map(([name, own]) => [name, JSON.stringify(own())])); // what both know
  let timer = null;
  const tell = () => {
    for (const [name, own] of Object.entries(parts)) {
      const now = own();
      const text = JSON.stringify(now);
      if (text !== told[name]) widget.set(name, now);
      told[name] = text;
    }
    widget.save_changes();
  };
  const later = () => {
    clearTimeout(timer);
    timer = setTimeout(tell, PAUSE);
  };
  const hear = (name, show) => async () => {
    const value = widget.get(name);
    const text = JSON.stringify(value);
    if (text === told[name]) return;
    told[name] = text;
    await show(value);
    later(); // it may have been rounded
  };
  const hears = {
    "change:wire": hear("wire", (wire) => become(app, wire)),
    "change:view": hear("view", (view) => view.K && app.look(view)),
    "change:things": () => app.showThings(widget.get("things")),
  };
  for (const act of Object.values(hears)) await act();
  for (const [name, act] of Object.entries(hears)) widget.on(name, act);
  app.ondraw = later; // whatever changes is drawn
  return () => {
    clearTimeout(timer);
    for (const [name, act] of Object.entries(hears)) widget.off(name, act);
  };
}

/** Show a state; a step of undo only if question, selection or edits differ. */
async function become(app, wire) {
  const { model } = app;
  const own = model.toJSON();
  const differs = (name) => JSON.stringify(own[name]) !== JSON.stringify(wire[name]);
  if (differs("words") || differs("sides")) return app.open(wire);
  if (differs("gamma")) model.setGamma(wire.gamma, true);
  model.arrange(wire);
  app.showSide();
}
