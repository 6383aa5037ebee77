// Optional layers of a stream: depth, confidence, and the view of its virtual camera. The server renders a layer only while it is subscribed.

import { Badge } from "./badge.js";
import { drawLegend } from "./legend.js";
import { Orbit } from "./orbit.js";
import { Viewer } from "./viewer.js";

const STORED = "intrasplat-layers";
const LAYERS = {
  depth: { title: "Depth", label: "Depth of the reconstruction in false colours" },
  confidence: { title: "Confidence", label: "Confidence in the reconstruction in false colours" },
  orbit: {
    title: "Orbit", note: "not the live view",
    label: "View of the virtual camera. Arrow keys turn it, plus and minus zoom, Home resets it.",
  },
};

const made = (tag, properties = {}, ...inside) => {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...inside);
  return element;
};

/** Create layer buttons in `choices` and images in `grid`. Returns `watch(stream)`, which shows the chosen layers of a stream. */
export function layersOf(choices, grid, report) {
  const chosen = new Set(JSON.parse(sessionStorage.getItem(STORED) ?? "[]").filter((layer) => layer in LAYERS));
  const open = new Map();
  let stream = "";

  for (const [layer, { title }] of Object.entries(LAYERS)) {
    const button = made("button", { type: "button", textContent: title, id: `choose-${layer}` });
    button.setAttribute("aria-pressed", String(chosen.has(layer)));
    button.addEventListener("click", () => {
      if (!chosen.delete(layer)) chosen.add(layer);
      button.setAttribute("aria-pressed", String(chosen.has(layer)));
      sessionStorage.setItem(STORED, JSON.stringify([...chosen]));
      show();
    });
    choices.append(button);
  }

  function show() {
    for (const [layer, picture] of open) {
      if (picture.stream === stream && chosen.has(layer)) continue;
      picture.close();
      open.delete(layer);
    }
    for (const layer of Object.keys(LAYERS)) {
      if (stream && chosen.has(layer) && !open.has(layer)) open.set(layer, new Picture(stream, layer, report));
    }
    // Keep the order of the buttons.
    grid.append(...Object.keys(LAYERS).filter((layer) => open.has(layer)).map((layer) => open.get(layer).figure));
    grid.dataset.count = String(grid.childElementCount);
  }

  return (name) => {
    stream = name;
    show();
  };
}

/** One layer: its figure, its viewer, and the controls of the virtual camera. */
class Picture {
  constructor(stream, layer, report) {
    const { title, note, label } = LAYERS[layer];
    const canvas = made("canvas", { id: layer, width: 640, height: 512 });
    canvas.setAttribute("aria-label", label);
    const badge = made("output");
    const caption = made("figcaption", {}, made("span", { textContent: title }), made("span", { className: "note", textContent: note ?? "" }), badge);
    const figure = made("figure", { className: `layer ${layer}` }, caption, canvas);
    Object.assign(this, { stream, figure, badge: new Badge(badge) });
    this.orbit = layer === "orbit" ? new Orbit(stream, canvas, report) : null;
    if (this.orbit) figure.append(this.orbit.controls);
    const legend = layer === "orbit" ? null : made("canvas", { className: "legend", width: 640, height: 40 });
    if (legend) figure.append(legend);
    this.viewer = new Viewer(stream, layer, canvas, {
      onPicture: (header) => {
        this.badge.say(layer === "orbit" && header.state === "live" ? { ...header, state: "virtual" } : header);
        if (legend) drawLegend(legend, header.legend);
        this.orbit?.shown(header.virtual);
      },
      onLost: () => this.badge.lost(),
    });
  }

  close() {
    this.viewer.close();
    this.badge.close();
    this.orbit?.close();
    this.figure.remove();
  }
}
