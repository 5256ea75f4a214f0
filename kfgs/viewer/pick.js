/** Finds the Gaussian under a pixel, and the Gaussians that are seen in a region. */

const LEAST = 1 / 255;
const BACKGROUND = 0.05; // a pixel covered less shows the background
const CELL = 4; // pixels between the places at which depth is looked up
const BEHIND = 1.03; // what is deeper by no more than this factor belongs to what is seen

/**
 * The Gaussian with the largest weight T alpha at a pixel; -1 for the background.
 * @param {Cloud} cloud
 * @param {{viewmat: Float32Array, fx: number, fy: number, cx: number, cy: number, width: number, height: number, near: number}} camera
 * @param {number} x pixels from the left
 * @param {number} y pixels from the top
 * @param {Uint8Array} drawn which Gaussians exist here
 */
export function gaussianAt(cloud, camera, x, y, drawn) {
  let left = 1, covered = 0, best = -1, most = 0;
  for (const splat of splatsIn(cloud, camera, [x, y, x, y], drawn)) {
    const alpha = alphaAt(splat, x, y);
    if (alpha < LEAST) continue;
    const after = left * (1 - alpha);
    if (after < 1e-4) break;
    const weight = alpha * left;
    covered += weight;
    if (weight > most) [best, most] = [splat.index, weight];
    left = after;
  }
  return covered < BACKGROUND ? -1 : best;
}

/** The Gaussians that may reach a box of the picture, [left, top, right, bottom], nearest first, with their ellipses. */
function splatsIn(cloud, camera, [x0, y0, x1, y1], drawn) {
  const {viewmat: m, fx, fy, cx, cy, width, height, near} = camera;
  const {means, reach} = {means: cloud.means, reach: cloud.reach ??= cloud.radii()};
  const limits = [(width / 2 - cx) / fx, (0.65 * width) / fx, (height / 2 - cy) / fy, (0.65 * height) / fy];
  const splats = [];
  for (let i = 0, j = 0; i < cloud.count; i++, j += 3) {
    if (reach[i] < 0) continue;
    const a = means[j], b = means[j + 1], c = means[j + 2];
    const z = m[8] * a + m[9] * b + m[10] * c + m[11];
    if (!(z > near)) continue;
    const tx = (m[0] * a + m[1] * b + m[2] * c + m[3]) / z;
    const ty = (m[4] * a + m[5] * b + m[6] * c + m[7]) / z;
    const jx = Math.min(Math.max(tx, limits[0] - limits[1]), limits[0] + limits[1]);
    const jy = Math.min(Math.max(ty, limits[2] - limits[3]), limits[2] + limits[3]);
    const x = fx * tx + cx, y = fy * ty + cy;
    const dx = x < x0 ? x0 - x : Math.max(x - x1, 0), dy = y < y0 ? y0 - y : Math.max(y - y1, 0);
    const rx = (fx / z) * reach[i], ry = (fy / z) * reach[i]; // 3.4 = what the low-pass of 0.3 adds, squared
    if (dx * dx > rx * rx * (1 + jx * jx) + 3.4 || dy * dy > ry * ry * (1 + jy * jy) + 3.4) continue;
    if (drawn[i]) splats.push({index: i, depth: Math.fround(z), x, y, ...ellipse(cloud, i, m, [fx / z, fy / z], [jx, jy])});
  }
  return splats.sort((p, q) => p.depth - q.depth || p.index - q.index);
}

/** The three axes of Gaussian i as unit vectors in the camera's axes, each with its standard deviation. */
function axesOf(cloud, i, m) {
  const [w, x, y, z] = cloud.quatOf(i);
  const columns = [
    [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
    [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
    [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
  ];
  const scales = cloud.scalesOf(i);
  const turned = ([a, b, c]) => [0, 4, 8].map((row) => m[row] * a + m[row + 1] * b + m[row + 2] * c);
  return columns.map((column, k) => [turned(column), scales[k]]);
}

/** The covariance (a, b; b, c) of Gaussian i on the screen, and its opacity there. */
function ellipse(cloud, i, m, focal, tangent) {
  let a = 0.3, b = 0, c = 0.3; // the low-pass
  for (const [turned, scale] of axesOf(cloud, i, m)) {
    const u = focal[0] * (turned[0] - tangent[0] * turned[2]) * scale;
    const v = focal[1] * (turned[1] - tangent[1] * turned[2]) * scale;
    a += u * u;
    b += u * v;
    c += v * v;
  }
  const det = a * c - b * b, plain = Math.max(0, (a - 0.3) * (c - 0.3) - b * b);
  return {a, b, c, det, opacity: cloud.opacityOf(i) * (cloud.meta.antialiased ? Math.sqrt(plain / det) : 1)};
}

/** alpha of a Gaussian at a place of the picture. */
function alphaAt({x, y, a, b, c, det, opacity}, px, py) {
  const dx = px - x, dy = py - y;
  return Math.min(0.99, opacity * Math.exp((-0.5 * (c * dx * dx - 2 * b * dx * dy + a * dy * dy)) / det));
}

/** The place in the world where Gaussian i is densest along the ray through a pixel: on the surface, if it is flat. */
export function meeting(cloud, i, {viewmat: m, fx, fy, cx, cy}, x, y) {
  const ray = [(x - cx) / fx, (y - cy) / fy, 1];
  const [a, b, c] = cloud.means.subarray(3 * i, 3 * i + 3);
  const middle = [0, 4, 8].map((row) => m[row] * a + m[row + 1] * b + m[row + 2] * c + m[row + 3]);
  let along = 0, across = 0;
  for (const [axis, scale] of axesOf(cloud, i, m)) {
    const [u, v] = [ray, middle].map((own) => (axis[0] * own[0] + axis[1] * own[1] + axis[2] * own[2]) / scale);
    along += u * v;
    across += u * u;
  }
  const place = ray.map((value, row) => (value * along) / across - m[4 * row + 3]);
  return [0, 1, 2].map((k) => m[k] * place[0] + m[4 + k] * place[1] + m[8 + k] * place[2]);
}

/** How deep one sees at a place of a box: a function of x and y, to where less than half of the light comes through. */
function depthsIn(cloud, camera, box, drawn) {
  const [x0, y0] = box;
  const [columns, rows] = [box[2] - x0, box[3] - y0].map((size) => Math.floor(size / CELL) + 2);
  const light = new Float32Array(columns * rows).fill(1), depths = new Float32Array(columns * rows).fill(Infinity);
  for (const splat of splatsIn(cloud, camera, box, drawn)) {
    const wide = 2 * Math.log(Math.max(splat.opacity / LEAST, 1));
    const span = (middle, spread, first, count) => {
      const half = Math.sqrt(wide * spread);
      return [Math.max(0, Math.ceil((middle - half - first) / CELL)), Math.min(count - 1, Math.floor((middle + half - first) / CELL))];
    };
    const [left, right] = span(splat.x, splat.a, x0, columns), [top, bottom] = span(splat.y, splat.c, y0, rows);
    for (let row = top; row <= bottom; row++) {
      for (let column = left, k = row * columns + left; column <= right; column++, k++) {
        if (light[k] < 0.5) continue;
        light[k] *= 1 - alphaAt(splat, x0 + CELL * column, y0 + CELL * row);
        if (light[k] < 0.5) depths[k] = splat.depth;
      }
    }
  }
  return (x, y) => depths[Math.round((y - y0) / CELL) * columns + Math.round((x - x0) / CELL)];
}

/**
 * A mask of the Gaussians whose centres lie in a polygon and are seen there.
 * @param {number[][]} polygon [x, y] in pixels of the camera's picture
 * @param {Uint8Array} drawn which Gaussians exist here
 * @param {boolean} through also those that are hidden behind others
 */
export function gaussiansIn(cloud, polygon, camera, drawn, through) {
  const {viewmat: m, fx, fy, cx, cy, near} = camera;
  const xs = polygon.map(([x]) => x), ys = polygon.map(([, y]) => y);
  const box = [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
  const seen = through ? () => Infinity : depthsIn(cloud, camera, box, drawn);
  const edges = polygon.map((from, k) => [...from, ...polygon[(k + 1) % polygon.length]]);
  const {means} = cloud;
  return drawn.map((on, i) => {
    const [a, b, c] = [means[3 * i], means[3 * i + 1], means[3 * i + 2]];
    const depth = m[8] * a + m[9] * b + m[10] * c + m[11];
    if (!on || !(depth > near)) return 0;
    const x = (fx * (m[0] * a + m[1] * b + m[2] * c + m[3])) / depth + cx;
    const y = (fy * (m[4] * a + m[5] * b + m[6] * c + m[7])) / depth + cy;
    if (x < box[0] || x > box[2] || y < box[1] || y > box[3]) return 0;
    let inside = 0; // by the even-odd rule
    for (const [ax, ay, bx, by] of edges) {
      if (ay > y !== by > y && x < ((bx - ax) * (y - ay)) / (by - ay) + ax) inside ^= 1;
    }
    return inside && depth <= BEHIND * seen(x, y) ? 1 : 0;
  });
}
