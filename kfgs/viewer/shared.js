/** Keeps a notebook's widget and Python alike (shared.py): what a person does is told, what Python sets is shown. */

const PAUSE = 150; // milliseconds after the last picture, before Python is told

/**
 * Share a viewer with anywidget's model, and show what Python set before there was a viewer. Returns a function that ends it.
 * @param {App} app see app.js
 * @param {object} widget has `wire`, in the form of `Model.toJSON`, and `view`, a camera as in the pack
 */
export async function share(app, widget) {
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
