/** Cameras that people move: pure functions on a view {R, position, distance}. R has the camera's x (right), y (down) and z
 * (forward) as rows, [9]; the pivot lies `distance` in front of the camera. */

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const add = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
const times = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const unit = (a) => times(a, 1 / (Math.hypot(...a) || 1));
const axis = (view, k) => view.R.slice(3 * k, 3 * k + 3);

/** The point that the camera turns around. */
export const pivot = (view) => add(view.position, axis(view, 2), view.distance);

/** A view from a camera of the pack ({viewmat: 16 numbers}), with the pivot at a distance. */
export function viewOf(viewmat, distance) {
  const m = viewmat;
  const R = [m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]];
  const position = [0, 1, 2].map((k) => -(m[k] * m[3] + m[4 + k] * m[7] + m[8 + k] * m[11]));
  return {R, position, distance};
}

/** The matrix from world to camera, row-major. */
export function viewmatOf({R, position}) {
  const t = [0, 1, 2].map((k) => -dot(R.slice(3 * k, 3 * k + 3), position));
  return Float32Array.from([...R.slice(0, 3), t[0], ...R.slice(3, 6), t[1], ...R.slice(6, 9), t[2], 0, 0, 0, 1]);
}

/** What `Renderer.setCamera` takes, for a view with a vertical field of view in radians. */
export function cameraOf(view, width, height, fov, near) {
  const f = height / 2 / Math.tan(fov / 2);
  return {viewmat: viewmatOf(view), fx: f, fy: f, cx: width / 2, cy: height / 2, width, height, near};
}

/**
 * Change a camera of the pack to another picture size, so that its picture lies in the middle.
 * @param {object} camera {viewmat, K: [fx, fy, cx, cy], width, height, near}
 * @param {number} scale of its picture; by default all of it is visible
 */
export function letterboxed({viewmat, K, width, height, near}, toWidth, toHeight, scale = Math.min(toWidth / width, toHeight / height)) {
  const [fx, fy, cx, cy] = K.map((value) => value * scale);
  const [left, top] = [(toWidth - scale * width) / 2, (toHeight - scale * height) / 2];
  return {viewmat, fx, fy, cx: cx + left, cy: cy + top, width: toWidth, height: toHeight, near};
}

/** A vector turned about a unit axis by an angle in radians (Rodrigues). */
export function turned(v, k, angle) {
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  return add(add(times(v, c), cross(k, v), s), k, dot(k, v) * (1 - c));
}

const turnedRows = (R, k, angle) => [0, 3, 6].flatMap((j) => turned(R.slice(j, j + 3), k, angle));

/** Turn by yaw about `up` and by pitch about the camera's right axis, radians; the view never tips over. */
function turn(R, yaw, pitch, up) {
  const once = turnedRows(R, unit(up), yaw);
  const height = Math.asin(Math.max(-1, Math.min(1, dot(once.slice(6), unit(up)))));
  const limit = Math.PI / 2 - 0.02;
  const allowed = Math.max(-limit, Math.min(limit, height + pitch)) - height;
  return straight(turnedRows(once, unit(once.slice(0, 3)), allowed));
}

/** Rows made orthonormal again, so that rounding does not add up. */
function straight(R) {
  const z = unit(R.slice(6));
  const x = unit(cross(R.slice(3, 6), z));
  return [...x, ...cross(z, x), ...z];
}

/** Orbit: turn about the pivot. */
export function orbit(view, yaw, pitch, up) {
  const R = turn(view.R, yaw, pitch, up);
  return {...view, R, position: add(pivot(view), R.slice(6), -view.distance)};
}

/** Look around from where the camera is. */
export const lookAround = (view, yaw, pitch, up) => ({...view, R: turn(view.R, yaw, pitch, up)});

/** Move with the pivot: dx, dy in pixels, so that the pivot follows the pointer. */
export function pan(view, dx, dy, focal) {
  const step = view.distance / focal;
  return {...view, position: add(add(view.position, axis(view, 0), -dx * step), axis(view, 1), -dy * step)};
}

/** Come closer to the pivot (factor < 1) or move away from it. */
export function zoom(view, factor) {
  const distance = Math.max(view.distance * factor, 1e-6);
  return {...view, distance, position: add(pivot(view), axis(view, 2), -distance)};
}

/** Fly: move by [right, up, forward] in world units, along the camera's axes. */
export function fly(view, [right, up, forward]) {
  return {...view, position: add(add(add(view.position, axis(view, 0), right), axis(view, 1), -up), axis(view, 2), forward)};
}

/**
 * Look at a ball from the same direction, so that it fills the picture.
 * @param {number} fov the smaller field of view in radians
 * @param {number} most largest distance
 */
export function fit(view, center, radius, fov, most = Infinity) {
  const distance = Math.min(Math.max(radius, 1e-6) / Math.sin(fov / 2), most);
  return {...view, distance, position: add(center, axis(view, 2), -distance)};
}

/** The view that looks from a position at a point. */
export function lookAt(position, point, up) {
  const z = unit(add(point, position, -1));
  const side = Math.abs(dot(z, unit(up))) > 0.999 ? (Math.abs(z[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0]) : up;
  const x = unit(cross(z, side));
  return {R: [...x, ...cross(z, x), ...z], position, distance: Math.hypot(...add(point, position, -1))};
}

/** A view between two, t from 0 to 1, for a smooth change. */
export function between(a, b, t) {
  const mix = (p, q) => p.map((value, k) => value + t * (q[k] - value));
  if (t >= 1) return b;
  return {
    R: straight(mix(a.R, b.R)),
    position: mix(a.position, b.position),
    distance: Math.exp((1 - t) * Math.log(a.distance) + t * Math.log(b.distance)),
  };
}
