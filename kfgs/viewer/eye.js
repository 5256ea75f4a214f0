/** The camera that a person moves: a view (camera.js) with its lens and its upward direction. */

import { between, cameraOf, fit, fly, letterboxed, lookAround, lookAt } from "./camera.js";
import { orbit, pan, pivot, turned, viewOf, viewmatOf, zoom } from "./camera.js";

const AXES = [[0, -1, 0], [0, 0, 1], [0, 1, 0], [1, 0, 0], [-1, 0, 0], [0, 0, -1]]; // that may be up
const FOV = 0.9; // radians, if the scene has no cameras
const TURN = 0.006; // radians for a pixel
const FLY = 0.4; // of the scene's radius for a second

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
    const away = aside.map((value, axis) => ball.center[axis] + ball.radius * (value + up[axis]));
    this.view = lookAt(away, ball.center, up);
    this.fit(ball);
  }

  /**
   * What Renderer.setCamera takes. No angle of view is wider than the photo's: beside an upright photo lies what few photos
   * show, and a very wide angle distorts. Thus some of the photo's longer side may be cut off, unless `whole`.
   */
  at(width, height) {
    const { lens } = this;
    this.size = [width, height];
    if (!lens) return cameraOf(this.view, width, height, Math.min(FOV, (FOV * height) / width), 0.01);
    const scale = this.whole ? undefined : Math.max(width, height) / Math.max(lens.width, lens.height);
    return letterboxed({ ...lens, viewmat: viewmatOf(this.view) }, width, height, scale);
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
    this.view = fit(this.view, center, radius, 2 * Math.atan(half), most);
    this.loose = false;
  }

  /** Look at a point, and turn about it from now on. */
  setPivot(point) {
    this.view = lookAt(this.view.position, point, this.up);
    this.loose = false;
  }

  orbit(dx, dy) {
    this.view = orbit(this.view, -TURN * dx, TURN * dy, this.up);
  }

  turn(dx, dy) {
    this.view = lookAround(this.view, (TURN / 2) * dx, -(TURN / 2) * dy, this.up);
    this.aim();
  }

  /** Take the next of the axes as up; or turn the picture by an angle in radians. */
  roll(angle = 0) {
    const at = AXES.findIndex((axis) => axis.every((value, k) => Math.abs(value - this.up[k]) < 0.01));
    this.up = angle ? turned(this.up, this.view.R.slice(6), angle) : AXES[(at + 1) % AXES.length];
    this.view = lookAt(this.view.position, pivot(this.view), this.up);
  }

  pan(dx, dy) {
    this.view = pan(this.view, dx, dy, this.focal);
  }

  zoom(factor) {
    this.view = zoom(this.view, factor);
  }

  /** Fly for so many seconds along [right, up, forward]. */
  fly(seconds, direction) {
    this.view = fly(this.view, direction.map((value) => value * seconds * FLY * this.ball.radius));
    this.aim();
  }

  /** The views on the way to another one. */
  toward(from, to, t) {
    this.view = between(from, to, t);
  }
}

/** How far a point lies in front of a view. */
const ahead = ({ position, R }, point) => point.reduce((all, value, axis) => all + (value - position[axis]) * R[6 + axis], 0);
