/** Finds the Gaussian under a pixel, and the Gaussians in a region: what kfgs.viewer.gaussian_at computes. */

const LEAST = 1 / 255;
const BACKGROUND = 0.05; // a pixel covered less shows the background

/**
 * The Gaussian with the largest weight T alpha at a pixel; -1 for the background.
 * @param {Cloud} cloud
 * @param {{viewmat: Float32Array, fx: number, fy: number, cx: number, cy: number, width: number, height: number, near: number}} camera
 * @param {number} x pixels from the left
 * @param {number} y pixels from the top
 * @param {Uint8Array} drawn which Gaussians exist here
 */
export function gaussianAt(cloud, camera, x, y, drawn) {
  const hits = hitsAt(cloud, camera, x, y, drawn);
  hits.sort((a, b) => a.depth - b.depth || a.index - b.index);
  let left = 1, covered = 0, best = -1, most = 0;
  for (const {index, alpha} of hits) {
    const after = left * (1 - alpha);
    if (after < 1e-4) break;
    const weight = alpha * left;
    covered += weight;
    if (weight > most) [best, most] = [index, weight];
    left = after;
  }
  return covered < BACKGROUND ? -1 : best;
}

/** Which Gaussians reach a pixel, with depth and alpha. */
function hitsAt(cloud, camera, x, y, drawn) {
  const {viewmat: m, fx, fy, cx, cy, width, height, near} = camera;
  const {means, reach} = {means: cloud.means, reach: cloud.reach ??= cloud.radii()};
  const limits = [(width / 2 - cx) / fx, (0.65 * width) / fx, (height / 2 - cy) / fy, (0.65 * height) / fy];
  const hits = [];
  for (let i = 0, j = 0; i < cloud.count; i++, j += 3) {
    if (reach[i] < 0) continue;
    const a = means[j], b = means[j + 1], c = means[j + 2];
    const z = m[8] * a + m[9] * b + m[10] * c + m[11];
    if (!(z > near)) continue;
    const tx = (m[0] * a + m[1] * b + m[2] * c + m[3]) / z;
    const ty = (m[4] * a + m[5] * b + m[6] * c + m[7]) / z;
    const jx = Math.min(Math.max(tx, limits[0] - limits[1]), limits[0] + limits[1]);
    const jy = Math.min(Math.max(ty, limits[2] - limits[3]), limits[2] + limits[3]);
    const dx = x - (fx * tx + cx), dy = y - (fy * ty + cy);
    const rx = (fx / z) * reach[i], ry = (fy / z) * reach[i]; // 3.4 = what the low-pass of 0.3 adds, squared
    if (dx * dx > rx * rx * (1 + jx * jx) + 3.4 || dy * dy > ry * ry * (1 + jy * jy) + 3.4) continue;
    if (!drawn[i]) continue;
    const alpha = alphaAt(cloud, i, m, [fx / z, fy / z], [jx, jy], [dx, dy]);
    if (alpha >= LEAST) hits.push({index: i, depth: Math.fround(z), alpha});
  }
  return hits;
}

/** alpha of Gaussian i at an offset (dx, dy) from its centre on the screen. */
function alphaAt(cloud, i, m, focal, tangent, offset) {
  const [w, x, y, z] = cloud.quatOf(i);
  const s = cloud.scalesOf(i);
  const R = [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
  let a = 0.3, b = 0, c = 0.3; // the low-pass
  for (let k = 0; k < 3; k++) {
    const turned = [0, 4, 8].map((row) => m[row] * R[0][k] + m[row + 1] * R[1][k] + m[row + 2] * R[2][k]);
    const u = focal[0] * (turned[0] - tangent[0] * turned[2]) * s[k];
    const v = focal[1] * (turned[1] - tangent[1] * turned[2]) * s[k];
    a += u * u;
    b += u * v;
    c += v * v;
  }
  const [dx, dy] = offset;
  const det = a * c - b * b, plain = Math.max(0, (a - 0.3) * (c - 0.3) - b * b);
  const opacity = cloud.opacityOf(i) * (cloud.meta.antialiased ? Math.sqrt(plain / det) : 1);
  const power = (c * dx * dx - 2 * b * dx * dy + a * dy * dy) / det;
  return Math.min(0.99, opacity * Math.exp(-0.5 * power));
}

/**
 * A mask of the Gaussians whose centres lie in a polygon.
 * @param {number[][]} polygon [x, y] in pixels of the camera's picture
 * @param {Uint8Array} drawn which Gaussians exist here
 */
export function gaussiansIn(cloud, polygon, camera, drawn) {
  const inside = inPolygon(polygon, camera);
  const {means} = cloud;
  return drawn.map((on, i) => (on && inside(means[3 * i], means[3 * i + 1], means[3 * i + 2]) ? 1 : 0));
}

/** Even-odd rule on the projected centre. */
function inPolygon(polygon, {viewmat: m, fx, fy, cx, cy, near}) {
  const edges = polygon.map((from, k) => [...from, ...polygon[(k + 1) % polygon.length]]);
  const xs = polygon.map(([x]) => x), ys = polygon.map(([, y]) => y);
  const [x0, x1, y0, y1] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
  return (a, b, c) => {
    const depth = m[8] * a + m[9] * b + m[10] * c + m[11];
    if (!(depth > near)) return false;
    const x = (fx * (m[0] * a + m[1] * b + m[2] * c + m[3])) / depth + cx;
    const y = (fy * (m[4] * a + m[5] * b + m[6] * c + m[7])) / depth + cy;
    if (x < x0 || x > x1 || y < y0 || y > y1) return false;
    let inside = false;
    for (const [ax, ay, bx, by] of edges) {
      if (ay > y !== by > y && x < ((bx - ax) * (y - ay)) / (by - ay) + ax) inside = !inside;
    }
    return inside;
  };
}
