/** Distances between points, [3 N]. */

/** The median distance to the nearest other Gaussian, from a sample. */
export function spacing(points) {
  const count = points.length / 3;
  const step = Math.max(1, Math.floor(count / 60));
  const found = [];
  for (let i = 0; i < count; i += step) {
    let least = Infinity;
    for (let j = 0; j < count; j++) {
      const far = squared(points, i, j);
      if (far > 0 && far < least) least = far;
    }
    found.push(Math.sqrt(least));
  }
  found.sort((a, b) => a - b);
  return found[found.length >> 1] || 1e-6;
}

export function squared(points, i, j) {
  let all = 0;
  for (let axis = 0; axis < 3; axis++) all += (points[3 * i + axis] - points[3 * j + axis]) ** 2;
  return all;
}

/** Which points lie within a distance of one that the mask has; with a grid of cells of that size. */
export function near(points, mask, reach) {
  const cells = new Map(); // of hashes: a cell may hold points of others, whose distances tell
  const hash = (x, y, z) => (x * 73856093) ^ (y * 19349663) ^ (z * 83492791);
  const cell = (i) => [0, 1, 2].map((axis) => Math.floor(points[3 * i + axis] / reach));
  const found = mask.slice();
  for (let i = 0; i < mask.length; i++) {
    if (!mask[i]) continue;
    const key = hash(...cell(i));
    if (!cells.has(key)) cells.set(key, []);
    cells.get(key).push(i);
  }
  const close = (i) => {
    const [x, y, z] = cell(i);
    for (let k = 0; k < 27; k++) {
      const others = cells.get(hash(x + (k % 3) - 1, y + (Math.floor(k / 3) % 3) - 1, z + Math.floor(k / 9) - 1));
      if (others?.some((j) => squared(points, i, j) <= reach * reach)) return true;
    }
    return false;
  };
  for (let i = 0; i < mask.length; i++) if (!mask[i] && close(i)) found[i] = 1;
  return found;
}
