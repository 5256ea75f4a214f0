/** Boxes of connected parts, with their names, over the view. */

import { svg } from "./dom.js";

const EDGES = [0, 1, 2, 3, 4, 5, 6, 7].flatMap((a) => [1, 2, 4].filter((bit) => !(a & bit)).map((bit) => [a, a | bit]));

/**
 * Draw boxes as lines.
 * @param {SVGElement} layer whose content is replaced
 * @param {{name: string, corners: number[][]}[]} boxes eight corners each, as OrientedBox.corners
 * @param {function(number[]): number[]|null} project a place in the world -> CSS pixels of the layer; null behind the camera
 */
export function drawBoxes(layer, boxes, project) {
  const made = boxes.flatMap(({ name, corners }) => {
    const seen = corners.map(project);
    const lines = EDGES.filter(([a, b]) => seen[a] && seen[b]).map(([a, b]) => `M${seen[a]}L${seen[b]}`);
    if (!lines.length) return [];
    const top = seen.filter(Boolean).reduce((best, one) => (one[1] < best[1] ? one : best));
    return [svg("path", { d: lines.join("") }), svg("text", { x: top[0], y: top[1] - 5 }, name)];
  });
  layer.replaceChildren(...made);
}
