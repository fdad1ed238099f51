// The distance between two points of the tissue, followed over time: the surface at a pixel as the renderer has it, and
// points that Gaussians carry as in model/carry.py.

const NUM_CARRIERS = 8;
const MIN_ALPHA = 0.5; // of the tissue at a pixel, to be measured
const BLUR = 0.3; // px squared
const ALPHA_MIN = 1 / 255;
const [AT_QUAT, AT_SCALE, AT_OPACITY] = [3, 7, 10]; // positions among the channels

// The rows of (3, 3) rotation times scales of a Gaussian, in camera axes.
function axesOf(number, view) {
  const q = [0, 1, 2, 3].map((k) => number(AT_QUAT + k));
  const [w, x, y, z] = q.map((part) => part / Math.hypot(...q));
  const rotation = [
    1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
    2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
    2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
  ];
  const scales = [0, 1, 2].map((k) => Math.exp(number(AT_SCALE + k)));
  return multiply(view.rotation, rotation).map((value, i) => value * scales[i % 3]);
}

// How opaque a Gaussian with center p (camera axes) is at a pixel; as in shaders.js.
function alphaAt(pixel, p, number, view) {
  const { focal, center, size } = view;
  const opacity = number(AT_OPACITY);
  const [dx, dy] = [0, 1].map((i) => pixel[i] - ((focal[i] * p[i]) / p[2] + center[i]));
  const widest = Math.exp(Math.max(...[0, 1, 2].map((k) => number(AT_SCALE + k))));
  const reach = 4 * ((2 * widest * Math.max(...focal)) / p[2] + 1); // px, generous: most Gaussians are far from the pixel
  if (opacity < ALPHA_MIN || Math.abs(dx) > reach || Math.abs(dy) > reach) return 0;
  const axes = axesOf(number, view);
  const [alongX, alongY] = [0, 1].map((i) => {
    const margin = (JACOBIAN_MARGIN * 0.5 * size[i]) / focal[i];
    const least = -center[i] / focal[i] - margin;
    const most = (size[i] - center[i]) / focal[i] + margin;
    const slope = Math.min(Math.max(p[i] / p[2], least), most);
    return [0, 1, 2].map((k) => (focal[i] / p[2]) * (axes[3 * i + k] - slope * axes[6 + k]));
  });
  const dot = (a, b) => a.reduce((sum, value, k) => sum + value * b[k], 0);
  const [xx, xy, yy] = [dot(alongX, alongX) + BLUR, dot(alongX, alongY), dot(alongY, alongY) + BLUR];
  const power = (-0.5 * (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy)) / (xx * yy - xy * xy);
  const alpha = Math.min(0.99, opacity * Math.exp(power));
  return alpha < ALPHA_MIN ? 0 : alpha;
}

// The point of the surface behind a pixel of a view, world axes, mm; null where there is none.
// parts: as `Blocks.parts` gives them.
function surfacePoint(parts, view, pixel) {
  const hits = [];
  for (const { gaussians, low, step, values } of parts) {
    for (let n = 0; n < gaussians; n++) {
      const number = (c) => low[c] + step[c] * values[c][n];
      const p = rotate(view.rotation, [number(0), number(1), number(2)]).map((v, i) => v + view.translation[i]);
      const alpha = p[2] > NEAR_Z ? alphaAt(pixel, p, number, view) : 0;
      if (alpha) hits.push([p[2], alpha]);
    }
  }
  hits.sort((a, b) => a[0] - b[0]);
  let [left, depth] = [1, 0];
  for (const [z, alpha] of hits) {
    depth += left * alpha * z;
    left *= 1 - alpha;
  }
  if (1 - left < MIN_ALPHA) return null;
  const z = depth / (1 - left);
  const inCamera = [...[0, 1].map((i) => ((pixel[i] - view.center[i]) / view.focal[i]) * z), z];
  const from = inCamera.map((v, i) => v - view.translation[i]);
  return [0, 1, 2].map((j) => [0, 1, 2].reduce((sum, i) => sum + view.rotation[3 * i + j] * from[i], 0));
}

// Pixel of a point in a view; null behind the camera.
function pixelOf(point, view) {
  const p = rotate(view.rotation, point).map((v, i) => v + view.translation[i]);
  return p[2] > NEAR_Z ? [0, 1].map((i) => (view.focal[i] * p[i]) / p[2] + view.center[i]) : null;
}

// Positions in every time step of a block, of a point that is at `point` in its step `from`, with the `square` of the
// carriers' spread; null where unknown. What is invisible has no position of its own: it carries nothing.
function carriedIn({ first, steps, gaussians, channels }, planes, point, from) {
  const number = (c, t, n) =>
    channels[c].low + channels[c].step * planes[c][planes[c].length > gaussians ? t * gaussians + n : n];
  const center = (t, n) => [0, 1, 2].map((c) => number(c, t, n));
  const nearest = []; // [distance, Gaussian], in order
  for (let n = 0; n < gaussians; n++) {
    if (number(AT_OPACITY, from, n) < ALPHA_MIN) continue;
    const far = Math.hypot(...center(from, n).map((v, i) => v - point[i]));
    if (nearest.length === NUM_CARRIERS && far >= nearest[NUM_CARRIERS - 1][0]) continue;
    nearest.push([far, n]);
    nearest.sort((a, b) => a[0] - b[0]);
    nearest.length = Math.min(nearest.length, NUM_CARRIERS);
  }
  const width = Math.max(nearest.reduce((sum, [far]) => sum + far, 0) / nearest.length, 1e-6);
  const carriers = nearest.map(([far, n]) => {
    const weight = number(AT_OPACITY, from, n) * Math.exp(-0.5 * (far / width) ** 2) + 1e-12;
    return { n, weight, start: center(from, n) };
  });
  return Array.from({ length: steps }, (_, t) => {
    const shown = carriers.filter(({ n }) => number(AT_OPACITY, t, n) >= ALPHA_MIN);
    if (!shown.length) return null;
    const total = shown.reduce((sum, { weight }) => sum + weight, 0);
    const ways = shown.map(({ n, weight, start }) => ({ step: center(t, n).map((v, i) => v - start[i]), weight: weight / total }));
    const mean = [0, 1, 2].map((i) => ways.reduce((sum, { step, weight }) => sum + weight * step[i], 0));
    const position = point.map((v, i) => v + mean[i]);
    position.square = squaredSpread(ways, mean, position, recordedView(about, first + t));
    return position;
  });
}

// The path of a point that is known in one time step: positions[t], undefined where it is not known (yet).
// In the middle of what two blocks show both, it is tied anew, to Gaussians of the other one.
async function follow(blocks, point, frame, path, goesOn) {
  const home = blocks.home(frame);
  const carry = async (k, at) => {
    const planes = await blocks.borrow(k);
    const { first } = blocks.blocks[k];
    const before = k === home ? 0 : path[at].square + about.ranges.tied_anew;
    return carriedIn(blocks.blocks[k], planes, path[at], at - first).map((position) => {
      if (position) position.square += before;
      return position ?? undefined;
    });
  };
  path[frame] = point;
  for (const onwards of [true, false]) {
    let at = frame;
    for (let k = home; at !== null && path[at] && k >= 0 && k < blocks.blocks.length; k += onwards ? 1 : -1) {
      const positions = await carry(k, at);
      if (!goesOn()) return;
      const { first, steps } = blocks.blocks[k];
      const [before, after] = [blocks.border(k - 1), blocks.border(k)];
      const [low, high] = [before ?? first, after ?? first + steps - 1];
      for (let t = low; t <= high; t++) path[t] = positions[t - first];
      at = onwards ? after : before;
    }
  }
}

// What is measured: two points, and where they are in each time step.
class Measuring {
  constructor(blocks) {
    this.blocks = blocks;
    this.following = Promise.resolve();
    this.clear();
  }

  clear() {
    this.points = []; // {frame, path}
    this.left = 0; // points that are still being followed
  }

  // Adds a point; after two of them it begins anew.
  add(point, frame) {
    if (this.points.length === 2) this.clear();
    const added = { frame, path: new Array(numFrames) };
    added.path[frame] = point;
    this.points.push(added);
    this.left++;
    const goesOn = () => this.points.includes(added);
    this.following = this.following
      .then(() => goesOn() && follow(this.blocks, point, frame, added.path, goesOn))
      .finally(() => { if (goesOn()) this.left--; });
    return this.following;
  }

  // Positions of the points in a time step; null where one is unknown.
  at(frame) {
    const found = this.points.map(({ path }) => path[frame]);
    return found.every(Boolean) ? found : null;
  }

  // Distance in every time step, NaN where unknown.
  distances() {
    return Array.from({ length: numFrames }, (_, t) => {
      const found = this.points.length === 2 && this.at(t);
      return found ? Math.hypot(...found[0].map((v, i) => v - found[1][i])) : NaN;
    });
  }

  // [distance, what else there is to say] in a time step.
  text(frame) {
    if (this.points.length < 2) return ["", this.points.length ? "Touch one more point." : "Touch two points of the tissue."];
    const distances = this.distances();
    const known = distances.filter(Number.isFinite);
    const since = this.points[1].frame;
    if (!Number.isFinite(distances[frame])) {
      return ["", this.left ? "Following the points…" : "The points are unknown in this frame."];
    }
    const change = distances[frame] - distances[since];
    const changed = Number.isFinite(change) ? `${change < 0 ? "−" : "+"}${Math.abs(change).toFixed(2)} since frame ${since + 1}; ` : "";
    const range = `${Math.min(...known).toFixed(2)} to ${Math.max(...known).toFixed(2)}`;
    const frames = known.length === numFrames ? "all frames" : `${known.length} frames`;
    const either = `± ${distanceRange(this.points, frame).toFixed(2)}`;
    return [`${distances[frame].toFixed(2)} ${either} ${about.unit} in 95 %`, known.length > 1 ? `${changed}${range} over ${frames}` : ""];
  }
}

// Draws the points, and the line between them, over the canvas.
function drawRuler(ruler, points, view) {
  const { width, height } = ruler.getBoundingClientRect();
  const places = (points ?? []).map((point) => pixelOf(point, view));
  const seen = places.map((place) => place && [(place[0] / view.size[0]) * width, (place[1] / view.size[1]) * height]);
  const [line, ...dots] = ruler.children;
  dots.forEach((dot, i) => {
    dot.style.display = seen[i] ? "" : "none";
    if (seen[i]) [["cx", seen[i][0]], ["cy", seen[i][1]]].forEach(([name, value]) => dot.setAttribute(name, value));
  });
  const both = Boolean(seen[0] && seen[1]);
  line.style.display = both ? "" : "none";
  if (!both) return;
  const ends = { x1: seen[0][0], y1: seen[0][1], x2: seen[1][0], y2: seen[1][1] };
  for (const [name, value] of Object.entries(ends)) line.setAttribute(name, value);
}
