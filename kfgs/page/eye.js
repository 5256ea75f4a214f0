/** The camera that a person moves: a view (camera.js) with its lens and its upward direction. */

import { between, cameraOf, fit, fly, letterboxed, lookAround, lookAt } from "./camera.js";
import { orbit, pan, viewOf, viewmatOf, zoom } from "./camera.js";

const FOV = 0.9; // radians, if the scene has no cameras
const TURN = 0.006; // radians for a pixel
const FLY = 0.4; // of the scene's radius for a second

export class Eye {
  /**
   * @param {{up: number[], cameras: object[]}} header of the pack
   * @param {{center: number[], radius: number}} ball where the scene is
   */
  constructor({ up, cameras }, ball) {
    this.up = up;
    this.ball = ball;
    this.lens = cameras[0] ?? null;
    this.focal = 1; // CSS pixels, of the last picture
    this.loose = true; // whether the pivot's distance is only a guess
    const aside = Math.abs(up[0]) < 0.9 ? [1, 0.6, 0.6] : [0.6, 1, 0.6];
    const away = aside.map((value, axis) => ball.center[axis] + ball.radius * (value + up[axis]));
    this.view = lookAt(away, ball.center, up);
    this.fit(ball);
  }

  /** What Renderer.setCamera takes. */
  at(width, height) {
    const near = this.lens?.near ?? 0.01;
    if (!this.lens) return cameraOf(this.view, width, height, Math.min(FOV, (FOV * height) / width), near);
    return letterboxed({ ...this.lens, viewmat: viewmatOf(this.view) }, width, height);
  }

  /** Look through a camera of the pack. */
  lookThrough(camera) {
    const view = viewOf(camera.viewmat, 1);
    this.view = { ...view, distance: Math.max(ahead(view, this.ball.center), 0.3 * this.ball.radius) };
    this.lens = camera;
    this.loose = true;
  }

  /** Show a ball as large as possible; `from`: no farther away than a camera, and from its side (a room has walls). */
  fit({ center, radius }, from = null) {
    const { fx, fy, width, height } = this.at(100, 100);
    if (from) this.view = lookAt(viewOf(from.viewmat, 1).position, center, this.up);
    const most = from ? this.view.distance : Infinity;
    this.view = fit(this.view, center, radius, 2 * Math.atan(Math.min(width / fx, height / fy) / 2), most);
    this.loose = false;
  }

  /** Turn about a point from now on; with `turned`, look at it. */
  setPivot(point, turned = false) {
    if (turned) this.view = lookAt(this.view.position, point, this.up);
    else this.view = { ...this.view, distance: Math.max(ahead(this.view, point), 1e-3) };
    this.loose = false;
  }

  orbit(dx, dy) {
    this.view = orbit(this.view, -TURN * dx, TURN * dy, this.up);
  }

  turn(dx, dy) {
    this.view = lookAround(this.view, (TURN / 2) * dx, -(TURN / 2) * dy, this.up);
    this.loose = true;
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
    this.loose = true;
  }

  /** The views on the way to another one. */
  toward(from, to, t) {
    this.view = between(from, to, t);
  }
}

/** How far a point lies in front of a view. */
const ahead = ({ position, R }, point) => point.reduce((all, value, axis) => all + (value - position[axis]) * R[6 + axis], 0);
