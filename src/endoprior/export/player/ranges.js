// How far carried points may be from the truth: half of the range that holds 95 % of the true values, as in
// model/uncertainty.py, whose numbers come with the page in `about.ranges`.

const WIDTH_PX = 640; // images count as if so wide
const [SEEN, NEAR, HIDDEN] = [0, 1, 2];

// Which cells of each time step's image show tissue: one bit a cell, row by row.
let tissueBits = null; // decoded when first asked for

function cellShows(frame, row, column) {
  const [rows, columns] = about.ranges.cells;
  if (row < 0 || column < 0 || row >= rows || column >= columns) return false;
  tissueBits ??= bytesOfBase64(about.ranges.tissue);
  const n = row * columns + column;
  const cellBytes = Math.ceil((rows * columns) / 8);
  return Boolean(tissueBits[frame * cellBytes + (n >> 3)] & (128 >> (n & 7)));
}

// Whether a pixel of a time step shows its point, is near what hides it or the border, or hides it.
function placeOf(pixel, frame) {
  const [rows, columns] = about.ranges.cells;
  if (!pixel) return HIDDEN;
  const [u, v] = [pixel[0] / about.width, pixel[1] / about.height];
  if (u < 0 || v < 0 || u > 1 || v > 1) return HIDDEN;
  const [row, column] = [Math.min(Math.floor(v * rows), rows - 1), Math.min(Math.floor(u * columns), columns - 1)];
  if (!cellShows(frame, row, column)) return HIDDEN;
  const around = [-1, 0, 1].flatMap((i) => [-1, 0, 1].map((j) => [row + i, column + j]));
  return around.every(([i, j]) => cellShows(frame, i, j)) ? SEEN : NEAR;
}

// By how much carriers disagree about the way of a point, px squared of an image 640 px wide.
// ways: {step: [x, y, z] mm, weight} of each; weights add up to 1.
function squaredSpread(ways, mean, point, view) {
  const z = rotate(view.rotation, point)[2] + view.translation[2];
  const mm = ways.reduce((sum, { step, weight }) => {
    const [x, y] = rotate(view.rotation, step.map((v, i) => v - mean[i]));
    return sum + weight * (x * x + y * y);
  }, 0);
  return z > 0 ? mm * ((view.focal[0] / z) * (WIDTH_PX / about.width)) ** 2 : Infinity;
}

// Squares of the half ranges of a position, mm: {ray, across, along}. `position.square` is its squared spread; `pick`
// and `start` are the time step and the position in which the point was touched.
function pointRange(position, frame, pick, start) {
  const { across, drift, start: first, noise } = about.ranges;
  const view = recordedView(about, frame);
  const inCamera = rotate(view.rotation, position).map((v, i) => v + view.translation[i]);
  const z = inCamera[2];
  const length = Math.hypot(...inCamera);
  const ray = [0, 1, 2].map((j) => [0, 1, 2].reduce((sum, i) => sum + view.rotation[3 * i + j] * inCamera[i], 0) / length);
  const pickView = recordedView(about, pick);
  const startZ = rotate(pickView.rotation, start)[2] + pickView.translation[2];
  const atPick = first[0] * (noise[pick] * startZ) ** 2 * first[1] ** 2;
  if (frame === pick) return { ray, across: 0, along: atPick };
  const mmPerPx = (z / view.focal[0]) * (about.width / WIDTH_PX);
  const moved = Math.hypot(...position.map((v, i) => v - start[i])) / mmPerPx;
  const place = placeOf(pixelOf(position, view), frame);
  const [floor, spread, way, reach] = across[place];
  const [depth, share, driftReach] = drift[place];
  const square = position.square ?? 0;
  return {
    ray,
    across: (floor + spread * square + way * moved ** 2) * mmPerPx ** 2 * reach ** 2,
    along: atPick + (depth * (noise[frame] * z) ** 2 + share * square * mmPerPx ** 2) * driftReach ** 2,
  };
}

// Half of the range of the distance of two points, {frame, path} each, in a time step, mm.
function distanceRange(points, frame) {
  const [a, b] = points.map(({ path }) => path[frame]);
  const length = Math.hypot(...a.map((v, i) => v - b[i]));
  const direction = a.map((v, i) => (v - b[i]) / Math.max(length, 1e-12));
  return Math.sqrt(
    points.reduce((sum, point) => {
      const of = pointRange(point.path[frame], frame, point.frame, point.path[point.frame]);
      const along = of.ray.reduce((dot, v, i) => dot + v * direction[i], 0) ** 2;
      return sum + Math.max(1 - along, 0) * of.across + along * of.along;
    }, 0),
  );
}
