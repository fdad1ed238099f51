// Where the scene is seen from. A view is {rotation, translation, focal, center, size}: world to camera (rows of the
// rotation one after the other, mm), and a pinhole in pixels of the recording; x right, y down, z forward. A recorded
// one has a `focus` too: the depth of the tissue there, mm.

const FARTHEST_ZOOM = 4;
const NEAREST_ZOOM = 0.1;
const STEEPEST_PITCH = 1.5;

function multiply(a, b) {
  const out = new Array(9);
  for (let i = 0; i < 3; i++) {
    for (let j = 0; j < 3; j++) out[3 * i + j] = a[3 * i] * b[j] + a[3 * i + 1] * b[3 + j] + a[3 * i + 2] * b[6 + j];
  }
  return out;
}

function rotate(m, [x, y, z]) {
  return [0, 3, 6].map((i) => m[i] * x + m[i + 1] * y + m[i + 2] * z);
}

// As recorded: the camera of that frame, its true principal point included.
function recordedView(about, frame) {
  const [fx, fy, cx, cy, ...pose] = about.cameras[Math.min(frame, about.cameras.length - 1)];
  return {
    rotation: [0, 1, 2, 4, 5, 6, 8, 9, 10].map((i) => pose[i]),
    translation: [3, 7, 11].map((i) => pose[i]),
    focal: [fx, fy],
    center: [cx, cy],
    size: [about.width, about.height],
    focus: about.focus[frame],
  };
}

// A free camera that starts as the recorded one and turns around the point at the center of its image.
class FreeCamera {
  constructor() {
    this.reset();
  }

  reset() {
    this.yaw = this.pitch = 0;
    this.zoom = 1; // distance to the point, as a share of what it was
    this.shift = [0, 0]; // mm
  }

  // By pixels of the recording: what is in front follows the hand.
  turn(dx, dy) {
    this.yaw -= dx * 0.006;
    this.pitch = Math.max(-STEEPEST_PITCH, Math.min(STEEPEST_PITCH, this.pitch + dy * 0.006));
  }

  move(dx, dy, base) {
    const distance = base.focus * this.zoom;
    this.shift = [this.shift[0] + (dx * distance) / base.focal[0], this.shift[1] + (dy * distance) / base.focal[1]];
  }

  approach(factor) {
    this.zoom = Math.max(NEAREST_ZOOM, Math.min(FARTHEST_ZOOM, this.zoom * factor));
  }

  // size: px of the recording that fit in the window, with the recorded image in the center.
  view(base, size) {
    const middle = base.size.map((length, i) => ((length / 2 - base.center[i]) / base.focal[i]) * base.focus);
    const pivot = [...middle, base.focus];
    const [sy, cy] = [Math.sin(this.yaw), Math.cos(this.yaw)];
    const [sp, cp] = [Math.sin(this.pitch), Math.cos(this.pitch)];
    const turned = multiply([1, 0, 0, 0, cp, -sp, 0, sp, cp], [cy, 0, sy, 0, 1, 0, -sy, 0, cy]);
    const away = [middle[0] * this.zoom + this.shift[0], middle[1] * this.zoom + this.shift[1], base.focus * this.zoom];
    const offset = rotate(turned, base.translation.map((t, i) => t - pivot[i]));
    return {
      rotation: multiply(turned, base.rotation),
      translation: offset.map((t, i) => t + away[i]),
      focal: base.focal,
      center: base.center.map((c, i) => c + (size[i] - base.size[i]) / 2),
      size,
    };
  }
}

// Weights that take the integers (x, y, z, 1) of a center of a block to its camera z, mm.
function depthWeights({ low, step }, view) {
  const row = view.rotation.slice(6, 9);
  const weights = row.map((r, i) => r * step[i]);
  return [...weights, view.translation[2] + row.reduce((sum, r, i) => sum + r * low[i], 0)];
}
