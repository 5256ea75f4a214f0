/** Recolouring with the shading kept: what kfgs.labels.recolor computes (kfgs/labels/color.py). */

const WEIGHTS = [0.2126, 0.7152, 0.0722]; // Rec. 709
const DARK = 1 / 255;

/** The luminance of a colour. */
export const luminance = ([r, g, b]) => WEIGHTS[0] * r + WEIGHTS[1] * g + WEIGHTS[2] * b;

/** The median of values, each with its weight. */
export function weightedMedian(values, weights) {
  const order = Uint32Array.from(values.keys()).sort((a, b) => values[a] - values[b]);
  const half = order.reduce((sum, i) => sum + weights[i], 0) / 2;
  let reached = 0;
  return values[order.find((i) => (reached += weights[i]) >= half) ?? order.at(-1)];
}

/**
 * What replaces each luminance when the luminance `middle` becomes a colour.
 * @param {number[]} rgb in 0..1
 * @param {number} middle
 * @returns {function(number): [number[], number[]]} luminance -> colour, and its change per unit of luminance
 */
export function tint(rgb, middle) {
  if (middle < DARK) return () => [rgb, [0, 0, 0]]; // no shading to keep
  const brightest = Math.max(...rgb);
  const peak = brightest > 0 ? rgb.map((value) => value / brightest) : [1, 1, 1];
  const knee = luminance(peak);
  const gain = luminance(rgb) / middle;
  const bend = gain <= 1 ? Infinity : Math.min(knee, (1 + luminance(rgb)) / 2) / gain;
  const straight = bend === Infinity ? gain : (1 - gain * bend) / (1 - bend);
  const rest = 1 - knee;
  const toWhite = peak.map((value) => (rest > 1e-6 ? (1 - value) / rest : 1));
  return (light) => {
    const tone = gain * Math.min(light, bend) + straight * Math.max(light - bend, 0);
    const rate = light > bend ? straight : gain;
    const slopes = tone > knee ? toWhite : peak.map((value) => value / knee);
    const color = slopes.map((slope, k) => (tone > knee ? peak[k] + slope * (tone - knee) : slope * tone));
    return [color, slopes.map((slope) => slope * rate)];
  };
}
