/**
 * The camera that a person moves: a view with its lens and its upward direction. A view {R, position, distance} has the
 * camera's x (right), y (down) and z (forward) as the rows of R, [9]; the pivot lies `distance` in front of the camera.
 */

const AXES = [[0, -1, 0], [0, 0, 1], [0, 1, 0], [1, 0, 0], [-1, 0, 0], [0, 0, -1]]; // that may be up
const FOV = 0.9; // radians, if the scene has no cameras
const TURN = 0.006; // radians for a pixel
const FLY = 0.4; // of the scene's radius for a second
const STEEP = Math.PI / 2 - 0.02; // radians: a view never tips over

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const add = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
const unit = (a) => add([0, 0, 0], a, 1 / (Math.hypot(...a) || 1));
const axis = (view, k) => view.R.slice(3 * k, 3 * k + 3);
const pivot = (view) => add(view.position, axis(view, 2), view.distance);

/** How far a point lies in front of a view. */
export const ahead = (view, point) => dot(add(point, view.position, -1), axis(view, 2));

export class Eye {
  /**
   * @param {{up: number[], cameras: object[], focus: number[]|null}} header of the pack
   * @param {{center: number[], radius: number}} ball where the scene is
   */
  constructor({ up, cameras, focus }, ball) {
    this.up = up;
    this.ball = ball;
    this.lens = cameras[0] ?? null;
    this.focal = 1; // CSS pixels, of the last picture
    this.size = [100, 100]; // of the last picture
    this.whole = false; // whether all of the lens's photo must be visible
    this.focus = cameras.length ? focus : ball.center; // what is in the middle of all; null: one stands inside
    this.loose = false; // whether a drag looks around, for there is nothing to turn about
    const aside = Math.abs(up[0]) < 0.9 ? [1, 0.6, 0.6] : [0.6, 1, 0.6];
    this.view = lookAt(add(ball.center, add(aside, up), ball.radius), ball.center, up);
    this.fit(ball);
  }

  /**
   * The `camera` of a renderer. No angle of view is wider than the photo's: beside an upright photo lies what few
   * photos show, and a very wide angle distorts. Thus some of the photo's longer side may be cut off, unless `whole`.
   */
  at(width, height) {
    const { lens } = this;
    const viewmat = viewmatOf(this.view);
    this.size = [width, height];
    if (!lens) {
      const f = height / 2 / Math.tan(Math.min(FOV, (FOV * height) / width) / 2);
      return { viewmat, fx: f, fy: f, cx: width / 2, cy: height / 2, width, height, near: 0.01 };
    }
    const own = [width / lens.width, height / lens.height];
    const scale = this.whole ? Math.min(...own) : Math.max(width, height) / Math.max(lens.width, lens.height);
    const [fx, fy, cx, cy] = lens.K.map((value) => value * scale);
    const [left, top] = [(width - scale * lens.width) / 2, (height - scale * lens.height) / 2];
    return { viewmat, fx, fy, cx: cx + left, cy: cy + top, width, height, near: lens.near };
  }

  /** Look through a camera of the pack. */
  lookThrough(camera) {
    const view = viewOf(camera.viewmat, 1);
    this.view = { ...view, distance: Math.max(ahead(view, this.ball.center), 0.3 * this.ball.radius) };
    this.lens = camera;
    this.aim();
  }

  /** Turn about the focus from now on, if it is in front. */
  aim() {
    const far = this.focus ? ahead(this.view, this.focus) : 0;
    this.loose = !(far > 0);
    if (far > 0) this.view = { ...this.view, distance: far };
  }

  /** Show a ball as large as possible; `from`: from a camera's side, and never smaller than the camera shows it (a room has walls). */
  fit({ center, radius }, from = null) {
    const { fx, fy, width, height } = this.at(...this.size);
    if (from) this.view = lookAt(viewOf(from.viewmat, 1).position, center, this.up);
    const half = Math.min(width / fx, height / fy) / 2; // tangent
    const own = from && Math.min(from.width / from.K[0], from.height / from.K[1]) / 2;
    const most = from ? this.view.distance * Math.max(own / half, 1) : Infinity;
    const distance = Math.min(Math.max(radius, 1e-6) / Math.sin(Math.atan(half)), most);
    this.view = { ...this.view, distance, position: add(center, axis(this.view, 2), -distance) };
    this.loose = false;
  }

  /** Look at a point, and turn about it from now on. */
  setPivot(point) {
    this.view = lookAt(this.view.position, point, this.up);
    this.loose = false;
  }

  /** Turn about the pivot; dx and dy are pixels of a drag. */
  orbit(dx, dy) {
    const R = turnedBy(this.view.R, -TURN * dx, TURN * dy, this.up);
    this.view = { ...this.view, R, position: add(pivot(this.view), R.slice(6), -this.view.distance) };
  }

  /** Look around from where the camera is. */
  turn(dx, dy) {
    this.view = { ...this.view, R: turnedBy(this.view.R, (TURN / 2) * dx, -(TURN / 2) * dy, this.up) };
    this.aim();
  }

  /** Take the next of the axes as up; or turn the picture by an angle in radians. */
  roll(angle = 0) {
    const at = AXES.findIndex((own) => own.every((value, k) => Math.abs(value - this.up[k]) < 0.01));
    this.up = angle ? turned(this.up, this.view.R.slice(6), angle) : AXES[(at + 1) % AXES.length];
    this.view = lookAt(this.view.position, pivot(this.view), this.up);
  }

  /** Move along the camera's axes [right, up, forward], in world units. */
  shift([right, up, forward]) {
    const aside = add(add(this.view.position, axis(this.view, 0), right), axis(this.view, 1), -up);
    this.view = { ...this.view, position: add(aside, axis(this.view, 2), forward) };
  }

  /** Move with the pivot, which follows the pointer. */
  pan(dx, dy) {
    const step = this.view.distance / this.focal;
    this.shift([-dx * step, dy * step, 0]);
  }

  /** Come closer to the pivot (factor < 1) or move away from it. */
  zoom(factor) {
    const before = this.view.distance;
    const distance = Math.max(before * factor, 1e-6);
    this.shift([0, 0, before - distance]);
    this.view = { ...this.view, distance };
  }

  /** Fly for so many seconds along [right, up, forward]. */
  fly(seconds, direction) {
    this.shift(direction.map((value) => value * seconds * FLY * this.ball.radius));
    this.aim();
  }
}

/** A view from a camera of the pack ({viewmat: 16 numbers}), with the pivot at a distance. */
export function viewOf(m, distance) {
  const R = [m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]];
  const position = [0, 1, 2].map((k) => -(m[k] * m[3] + m[4 + k] * m[7] + m[8 + k] * m[11]));
  return { R, position, distance };
}

/** A view between two, t from 0 to 1, for a smooth change. */
export function between(a, b, t) {
  const mix = (p, q) => p.map((value, k) => value + t * (q[k] - value));
  if (t >= 1) return b;
  const distance = Math.exp((1 - t) * Math.log(a.distance) + t * Math.log(b.distance));
  return { R: straight(mix(a.R, b.R)), position: mix(a.position, b.position), distance };
}

/** The view that looks from a position at a point. */
function lookAt(position, point, up) {
  const z = unit(add(point, position, -1));
  const side = Math.abs(dot(z, unit(up))) > 0.999 ? (Math.abs(z[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0]) : up;
  const x = unit(cross(z, side));
  return { R: [...x, ...cross(z, x), ...z], position, distance: Math.hypot(...add(point, position, -1)) };
}

/** The matrix from world to camera, row-major. */
function viewmatOf({ R, position }) {
  const t = [0, 1, 2].map((k) => -dot(R.slice(3 * k, 3 * k + 3), position));
  return Float32Array.from([...R.slice(0, 3), t[0], ...R.slice(3, 6), t[1], ...R.slice(6, 9), t[2], 0, 0, 0, 1]);
}

/** A vector turned about a unit axis by an angle in radians (Rodrigues). */
function turned(v, k, angle) {
  const aside = add([0, 0, 0], v, Math.cos(angle));
  return add(add(aside, cross(k, v), Math.sin(angle)), k, dot(k, v) * (1 - Math.cos(angle)));
}

/** Rows turned by yaw about `up` and by pitch about the camera's right axis, radians; the view never tips over. */
function turnedBy(R, yaw, pitch, up) {
  const rows = (own, k, angle) => [0, 3, 6].flatMap((j) => turned(own.slice(j, j + 3), k, angle));
  const once = rows(R, unit(up), yaw);
  const height = Math.asin(Math.max(-1, Math.min(1, dot(once.slice(6), unit(up)))));
  const allowed = Math.max(-STEEP, Math.min(STEEP, height + pitch)) - height;
  return straight(rows(once, unit(once.slice(0, 3)), allowed));
}

/** Rows made orthonormal again, so that rounding does not add up. */
function straight(R) {
  const z = unit(R.slice(6));
  const x = unit(cross(R.slice(3, 6), z));
  return [...x, ...cross(z, x), ...z];
}
