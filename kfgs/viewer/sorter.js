/**
 * Sorts the Gaussians in view by depth, nearest first, as the rasteriser does: by depth, then by index.
 *
 * `sorterMain` is the whole program of the worker. It uses nothing from outside, so its text can start a worker from a
 * Blob, where no file can be loaded.
 */

/**
 * Answer messages. "load" gives {side, means, radii}; "sort" {side, load, share, view, limits,
 * near} is answered by {side, load, order}; with a share below 1 always the same Gaussians are left out, chosen at random.
 * @param {{onmessage: ?function, postMessage: function}} scope the worker, or an object like it
 */
export function sorterMain(scope) {
  const clouds = {};
  const buckets = [new Uint32Array(65536), new Uint32Array(65536)];

  /** Find the Gaussians in view and their depths; fills cloud.seen and cloud.keys, returns how many. */
  function look(cloud, share, view, limits, near) {
    const {means, radii, seen, depths} = cloud;
    const [x0, x1, y0, y1, slack] = limits; // tangents of the borders; slack: tangent of two pixels
    const wide = Math.max(x1, -x0) * 1.3;
    const high = Math.max(y1, -y0) * 1.3;
    const most = share * 4294967296;
    let count = 0;
    for (let i = 0, j = 0; i < radii.length; i++, j += 3) {
      const a = means[j], b = means[j + 1], c = means[j + 2];
      const z = view[8] * a + view[9] * b + view[10] * c + view[11];
      const radius = radii[i];
      if (!(z > near) || radius < 0 || Math.imul(i, 2654435761) >>> 0 >= most) continue; // Knuth's hash
      const x = (view[0] * a + view[1] * b + view[2] * c + view[3]) / z;
      const y = (view[4] * a + view[5] * b + view[6] * c + view[7]) / z;
      const tx = Math.min(Math.abs(x), wide), ty = Math.min(Math.abs(y), high);
      const reach = radius / z;
      const rx = reach * Math.sqrt(1 + tx * tx) + slack;
      const ry = reach * Math.sqrt(1 + ty * ty) + slack;
      if (x + rx < x0 || x - rx > x1 || y + ry < y0 || y - ry > y1) continue;
      depths[count] = z;
      seen[count++] = i;
    }
    return count;
  }

  /** Sort by the bits of the depth, which have the order of positive floats: two passes of a counting sort. */
  function sort(cloud, count) {
    const {seen, other} = cloud;
    const bits = new Uint32Array(cloud.depths.buffer, 0, count);
    const [low, high] = buckets;
    low.fill(0);
    high.fill(0);
    for (let i = 0; i < count; i++) {
      low[bits[i] & 65535]++;
      high[bits[i] >>> 16]++;
    }
    let a = 0, b = 0;
    for (let k = 0; k < 65536; k++) {
      const m = low[k], n = high[k];
      low[k] = a;
      high[k] = b;
      a += m;
      b += n;
    }
    for (let i = 0; i < count; i++) other[low[bits[i] & 65535]++] = i;
    const order = new Uint32Array(count);
    for (let i = 0; i < count; i++) order[high[bits[other[i]] >>> 16]++] = seen[other[i]];
    return order;
  }

  const answers = {
    load({side, means, radii}) {
      const n = radii.length;
      clouds[side] = {means, radii, seen: new Uint32Array(n), other: new Uint32Array(n), depths: new Float32Array(n)};
    },
    sort({side, load, share, view, limits, near}) {
      const cloud = clouds[side];
      const order = sort(cloud, look(cloud, share, view, limits, near));
      scope.postMessage({side, load, order}, [order.buffer]);
    },
  };
  scope.onmessage = ({data}) => answers[data.kind](data);
}

/**
 * Start the sorter in a worker; where the browser forbids that, in this thread.
 * @param {function} answer called with each {side, load, order}
 * @returns {{send: function(object, Array=): void, close: function(): void}}
 */
export function startSorter(answer) {
  let unanswered = []; // sent again if the worker cannot start; null once it has answered
  const local = () => {
    const scope = {postMessage: (data) => answer(data)};
    sorterMain(scope);
    return (data) => setTimeout(() => scope.onmessage({data}), 0);
  };
  let send, worker, url;
  try {
    url = URL.createObjectURL(new Blob([`(${sorterMain})(self);`], {type: "text/javascript"}));
    worker = new Worker(url);
    worker.onmessage = ({data}) => {
      unanswered = null;
      answer(data);
    };
    worker.onerror = () => {
      worker.terminate();
      send = local();
      unanswered?.forEach((data) => send(data));
      unanswered = null;
    };
    send = (data) => {
      unanswered?.push(data);
      worker.postMessage(data);
    };
  } catch {
    send = local();
  }
  return {
    send: (data) => send(data),
    close: () => {
      worker?.terminate();
      if (url) URL.revokeObjectURL(url);
    },
  };
}
