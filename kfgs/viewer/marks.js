/** What stands over the view in lines and letters: boxes, labels, the measuring tape. */

import { svg } from "./dom.js";

const EDGES = [0, 1, 2, 3, 4, 5, 6, 7].flatMap((a) => [1, 2, 4].filter((bit) => !(a & bit)).map((bit) => [a, a | bit]));

/**
 * Marks with their names, which end at the border of their pane.
 * @param {{name: string, places: number[][]}[]} marks places in the world: eight corners of a box, in the order of
 *   OrientedBox.corners; two ends of a line; or one place for a label
 * @param {{x: number, width: number, height: string}} pane where it is, CSS pixels
 * @param {function(number[]): number[]|null} project a place in the world -> CSS pixels of the pane; null: behind it
 */
export function marksIn(marks, pane, project) {
  const made = marks.flatMap(({ name, places }) => {
    const seen = places.map(project);
    const there = seen.filter(Boolean);
    if (!there.length) return [];
    const box = seen.length === 8;
    const lines = EDGES.filter(([a, b]) => seen[a] && seen[b]).map(([a, b]) => `M${seen[a]}L${seen[b]}`);
    const dots = box ? [] : there.map((place) => `M${place}h0`);
    const top = there.reduce((best, one) => (one[1] < best[1] ? one : best));
    const [x, y] = box ? top : [0, 1].map((axis) => there.reduce((all, place) => all + place[axis], 0) / there.length);
    return [
      svg("path", { d: lines.join("") }), svg("path", { d: dots.join(""), class: "dots" }),
      svg("text", { x, y: y - (box ? 5 : 9) }, name),
    ];
  });
  return svg("svg", pane, ...made);
}
