// The page: what is shown (one state), and the buttons, keys and hands that change it.

const NEAR_Z = 0.2; // mm
const MAX_PIXELS_PER_PIXEL = 2; // rendered per recorded one; more would add no detail
const LONGEST_STEP = 0.25; // s that playing may jump when the browser was busy
const BUDGET = 60; // ms for an image in motion: fewer pixels if it takes longer, all of them once it is static
const COARSEST = 0.25; // of the full width
const REST = 250; // ms after the last change
const TAP = 6; // px: a finger that moves less has touched, not dragged
const SWAY = { angle: 0.12, period: 6, turns: 2 }; // rad to both sides, s, how often: the start shows that it is a model

const byId = (id) => document.getElementById(id);
const stage = byId("stage");
const canvas = byId("picture");
const ruler = byId("ruler");
const about = JSON.parse(byId("about").textContent);
const numFrames = about.seconds.length;
const state = { frame: 0, clock: 0, playing: false, speed: 1, loop: true, free: false, depth: false, smoke: false, base: 0, measuring: false };
const hand = new FreeCamera();
const swaying = new FreeCamera(); // until the first touch
let swayedFor = window.matchMedia("(prefers-reduced-motion: reduce)").matches ? Infinity : 0; // s
let blocks = null;
let painter = null;
let sorter = null;
let measuring = null;
let pageWindow = null;
let shown = null; // {frame, parts, view} of the image on the canvas
let stale = true;
let changedAt = 0; // ms, by hand
let quality = 1; // share of the full width that can be rendered within the budget
let drawnQuality = 0;

function changed() {
  stale = true;
  changedAt = performance.now();
}

function failWith(error) {
  console.error(error);
  byId("message").firstElementChild.textContent = error.message;
  document.body.dataset.state = "failed";
  stage.removeAttribute("aria-busy");
}

// ---- rendering

// Places the canvas: the recorded frame as large as it fits, or for the free view the whole stage at the same scale.
function layOut(share) {
  const { clientWidth: width, clientHeight: height } = stage;
  const { scale } = fit();
  const [w, h] = state.free ? [width, height] : [Math.round(about.width * scale), Math.round(about.height * scale)];
  const place = { width: w, height: h, left: Math.floor((width - w) / 2), top: Math.floor((height - h) / 2) };
  for (const [name, length] of Object.entries(place)) canvas.style[name] = ruler.style[name] = `${length}px`;
  const density = share * Math.min(window.devicePixelRatio || 1, MAX_PIXELS_PER_PIXEL / scale);
  const buffer = [w, h].map((length) => Math.max(1, Math.round(length * density)));
  if (canvas.width !== buffer[0]) canvas.width = buffer[0];
  if (canvas.height !== buffer[1]) canvas.height = buffer[1];
}

// The stage's scale (CSS px per recorded one) and its size in recorded px.
function fit() {
  const { clientWidth: width, clientHeight: height } = stage;
  const scale = Math.max(Math.min(width / about.width, height / about.height), 0.01);
  return { scale, size: [width / scale, height / scale] };
}

// A free view starts at the endoscope. Within one window it stays there; over several it goes along with the endoscope,
// because what it showed at first is not shown any more after a while.
function freeBase() {
  return recordedView(about, about.blocks.length > 1 ? state.frame : state.base);
}

function requestPicture(share) {
  stale = false;
  const { free, depth, frame } = state;
  const smoke = state.smoke && !free; // only the endoscope saw it
  const recorded = free ? freeBase() : recordedView(about, frame);
  const beside = swayedFor < Infinity ? swaying.view(recorded, recorded.size) : recorded;
  const view = free ? hand.view(recorded, fit().size) : beside;
  sorter.ask({ frame, parts: blocks.parts(frame), nearZ: NEAR_Z, view, depth, smoke, share }).catch(failWith);
}

// Called by the sorter with the order and its request.
function drawAnswer(order, { frame, parts, view, depth, smoke, share }) {
  layOut(share);
  painter.draw(frame, parts, order, view, depth, smoke);
  drawnQuality = share;
  shown = { frame, parts, view };
  drawRuler(ruler, measuring.at(frame), view);
  canvas.dataset.frame = frame;
  canvas.dataset.drawn = Number(canvas.dataset.drawn || 0) + 1;
  if (document.body.dataset.state === "loading") document.body.dataset.state = "ready";
}

// ---- time

const lastStep = numFrames > 1 ? (about.seconds[numFrames - 1] - about.seconds[0]) / (numFrames - 1) : 0;
const ending = about.seconds[numFrames - 1] + lastStep;

function frameAt(clock) {
  let frame = 0;
  while (frame + 1 < numFrames && about.seconds[frame + 1] <= clock + 1e-9) frame++;
  return frame;
}

function showFrame(frame) {
  state.frame = Math.max(0, Math.min(numFrames - 1, frame));
  state.clock = about.seconds[state.frame];
  changed();
  tellWhere();
}

function setPlaying(playing) {
  state.playing = playing && numFrames > 1;
  if (state.playing && state.frame === numFrames - 1) showFrame(0);
  document.body.classList.toggle("playing", state.playing);
  byId("play").setAttribute("aria-label", state.playing ? "Pause" : "Play");
}

function advance(seconds) {
  state.clock += Math.min(seconds, LONGEST_STEP) * state.speed;
  if (state.clock >= ending) {
    if (!state.loop) {
      showFrame(numFrames - 1);
      setPlaying(false);
      return;
    }
    state.clock = about.seconds[0] + ((state.clock - about.seconds[0]) % (ending - about.seconds[0]));
  }
  const frame = frameAt(state.clock);
  if (frame === state.frame) return;
  state.frame = frame;
  stale = true;
  tellWhere();
}

function tellWhere() {
  const counter = `Frame ${state.frame + 1} of ${numFrames}`;
  const seconds = `${about.seconds[state.frame].toFixed(2)} s`;
  byId("counter").textContent = counter;
  byId("seconds").textContent = seconds;
  byId("slider").value = state.frame;
  byId("slider").setAttribute("aria-valuetext", `${counter}, ${seconds}`);
  tellMeasured();
}

// ---- view

// One step of the sway at the start; it ends in the recorded view.
function sway(seconds) {
  if (swayedFor === Infinity) return;
  swayedFor += Math.min(seconds, LONGEST_STEP);
  if (swayedFor >= SWAY.turns * SWAY.period) return endSway();
  document.body.dataset.sway = "on";
  swaying.yaw = SWAY.angle * Math.sin((2 * Math.PI * swayedFor) / SWAY.period);
  stale = true;
}

function endSway() {
  if (swayedFor === Infinity) return;
  swayedFor = Infinity;
  swaying.reset();
  document.body.dataset.sway = "ended";
  changed();
}

function setFree(free) {
  if (free && !state.free) state.base = state.frame;
  state.free = free;
  byId("endoscope").setAttribute("aria-pressed", !free);
  byId("free").setAttribute("aria-pressed", free);
  byId("reset").disabled = !free;
  byId("smoke").disabled = free;
  changed();
}

function setDepth(depth) {
  state.depth = depth;
  byId("depth").setAttribute("aria-pressed", depth);
  byId("scale").hidden = !depth;
  changed();
}

function setSmoke(smoke) {
  state.smoke = smoke;
  byId("smoke").setAttribute("aria-pressed", smoke);
  changed();
}

function setLoop(loop) {
  state.loop = loop;
  byId("loop").setAttribute("aria-pressed", loop);
}

// ---- measuring

function setMeasuring(on) {
  state.measuring = on;
  document.body.classList.toggle("measuring", on);
  byId("measure").setAttribute("aria-pressed", on);
  tellMeasured();
}

function tellMeasured(problem = "") {
  const points = measuring ? measuring.points.length : 0;
  const [length, rest] = problem ? ["", problem] : points || state.measuring ? measuring.text(state.frame) : ["", ""];
  const strong = document.createElement("b");
  strong.textContent = length;
  byId("measured").replaceChildren(...(length ? [strong] : []), rest);
  byId("measured").hidden = !length && !rest;
  byId("clear").hidden = !points;
}

// A touch of the tissue, in CSS px of the window.
function measureAt(x, y) {
  const { left, top, width, height } = canvas.getBoundingClientRect();
  const { frame, parts, view } = shown;
  const pixel = [((x - left) / width) * view.size[0], ((y - top) / height) * view.size[1]];
  const point = surfacePoint(parts, view, pixel);
  if (!point) return tellMeasured("There is no surface there: touch the tissue.");
  const update = () => { tellMeasured(); stale = true; };
  measuring.add(point, frame).then(update).catch(failWith);
  update();
}

function clearMeasured() {
  measuring.clear();
  tellMeasured();
  stale = true;
}

// ---- hands: one finger or button turns, two fingers or another button move, wheel and pinch zoom

const touching = new Map();
let tapFrom = null; // where the only finger came down, until it drags

function middleAndSpread() {
  const points = [...touching.values()];
  const middle = [0, 1].map((i) => points.reduce((sum, p) => sum + p[i], 0) / points.length);
  const spread = points.length < 2 ? 0 : Math.hypot(points[0][0] - points[1][0], points[0][1] - points[1][1]);
  return { middle, spread };
}

function onDown(event) {
  canvas.setPointerCapture(event.pointerId);
  touching.set(event.pointerId, [event.clientX, event.clientY]);
  tapFrom = touching.size === 1 && event.button === 0 ? [event.clientX, event.clientY] : null;
  canvas.classList.add("turning");
}

function onMove(event) {
  if (!touching.has(event.pointerId)) return;
  if (tapFrom && Math.hypot(event.clientX - tapFrom[0], event.clientY - tapFrom[1]) < TAP) return;
  tapFrom = null;
  const before = middleAndSpread();
  touching.set(event.pointerId, [event.clientX, event.clientY]);
  const after = middleAndSpread();
  const { scale } = fit();
  const [dx, dy] = [0, 1].map((i) => (after.middle[i] - before.middle[i]) / scale);
  if (!dx && !dy && before.spread === after.spread) return;
  if (!state.free) setFree(true);
  if (touching.size > 1 || event.buttons & 6 || event.shiftKey) hand.move(dx, dy, freeBase());
  else hand.turn(dx, dy);
  if (before.spread > 0 && after.spread > 0) hand.approach(before.spread / after.spread);
  document.body.classList.add("gestured");
  changed();
}

function onUp(event) {
  if (tapFrom && event.type === "pointerup" && state.measuring) measureAt(...tapFrom);
  tapFrom = null;
  touching.delete(event.pointerId);
  if (!touching.size) canvas.classList.remove("turning");
}

function onWheel(event) {
  event.preventDefault();
  const lines = event.deltaMode === 1 ? 30 : 1;
  zoom(Math.exp(Math.max(-200, Math.min(200, event.deltaY * lines)) * 0.0015));
}

// ---- keys

const KEYS = {
  " ": () => setPlaying(!state.playing),
  ArrowLeft: () => step(-1),
  ArrowRight: () => step(1),
  Home: () => showFrame(0),
  End: () => showFrame(numFrames - 1),
  e: () => setFree(false),
  f: () => setFree(true),
  d: () => setDepth(!state.depth),
  s: () => about.smoke && !state.free && setSmoke(!state.smoke),
  l: () => setLoop(!state.loop),
  m: () => setMeasuring(!state.measuring),
  c: () => pageWindow.setFolded(!pageWindow.folded),
  w: () => pageWindow.setFull(!pageWindow.full),
  Escape: () => pageWindow.setFull(false),
  r: () => hand.reset(),
  "+": () => zoom(0.9),
  "=": () => zoom(0.9),
  "-": () => zoom(1 / 0.9),
};
const TURNS = { ArrowLeft: [-20, 0], ArrowRight: [20, 0], ArrowUp: [0, -20], ArrowDown: [0, 20] };

function step(by) {
  setPlaying(false);
  showFrame(state.frame + by);
}

function zoom(factor) {
  if (!state.free) setFree(true);
  hand.approach(factor);
  changed();
}

function onKey(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest("select")) return;
  if (event.key === " " && event.target.closest("button")) return; // presses that button
  const turn = event.shiftKey && TURNS[event.key];
  const act = turn ? () => hand.turn(...turn) : KEYS[event.key.length === 1 ? event.key.toLowerCase() : event.key];
  if (!act) return;
  event.preventDefault();
  if (turn && !state.free) setFree(true);
  act();
  changed();
}

// ---- start

function connect() {
  byId("controls").inert = false;
  const slider = byId("slider");
  slider.max = numFrames - 1;
  slider.addEventListener("input", () => {
    setPlaying(false);
    showFrame(Number(slider.value));
  });
  const clicks = {
    play: () => setPlaying(!state.playing),
    previous: () => step(-1),
    next: () => step(1),
    loop: () => setLoop(!state.loop),
    endoscope: () => setFree(false),
    free: () => setFree(true),
    depth: () => setDepth(!state.depth),
    smoke: () => setSmoke(!state.smoke),
    measure: () => setMeasuring(!state.measuring),
    clear: clearMeasured,
    reset: () => { hand.reset(); changed(); },
    fold: () => pageWindow.setFolded(!pageWindow.folded),
    full: () => pageWindow.setFull(!pageWindow.full),
  };
  for (const [id, act] of Object.entries(clicks)) {
    byId(id).addEventListener("click", (event) => {
      act();
      if (event.detail) event.currentTarget.blur(); // by mouse: leave the space bar to playing
    });
  }
  byId("speed").addEventListener("change", (event) => {
    state.speed = Number(event.target.value);
    event.target.blur();
  });
  for (const id of ["slider", "play", "previous", "next", "loop", "speed"]) byId(id).disabled = numFrames < 2;
  canvas.addEventListener("pointerdown", onDown);
  canvas.addEventListener("pointermove", onMove);
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, onUp);
  canvas.addEventListener("wheel", onWheel, { passive: false });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
  canvas.addEventListener("webglcontextrestored", () => {
    painter.start();
    stale = true;
  });
  document.addEventListener("keydown", onKey);
  for (const name of ["pointerdown", "wheel", "keydown"]) document.addEventListener(name, endSway, { capture: true });
  new ResizeObserver(() => { stale = true; }).observe(stage);
}

function describe() {
  const size = `${about.width} × ${about.height} px`;
  const frames = numFrames === 1 ? "1 frame" : `${numFrames} frames`;
  byId("facts").textContent = `${about.gaussians.toLocaleString("en")} Gaussians · ${size} · ${frames}`;
  byId("smoke").hidden = !about.smoke;
  const [near, far] = about.depth_range;
  byId("scale-near").textContent = near.toFixed(0);
  byId("scale-far").textContent = far.toFixed(0);
  document.querySelector(".ramp").style.background =
    `linear-gradient(${DEPTH_COLORS.map((c) => `rgb(${c})`).join(",")})`;
}

// Rendering time decides the resolution while something moves.
function learnFrom(took) {
  const full = took / drawnQuality ** 2; // ms if all pixels were rendered
  const wanted = Math.max(COARSEST, Math.min(1, Math.sqrt(BUDGET / full)));
  quality = Math.abs(wanted - quality) < 0.1 ? quality : wanted;
}

function run() {
  let before = performance.now();
  const tick = (now) => {
    const ready = blocks.ready(state.frame);
    if (state.playing && ready) advance((now - before) / 1000);
    if (state.playing && !ready) canvas.dataset.waits = Number(canvas.dataset.waits || 0) + 1;
    blocks.want(state.frame).catch(failWith);
    canvas.dataset.unpacked = [...blocks.planes.keys()].filter((k) => blocks.planes[k]);
    sway((now - before) / 1000);
    before = now;
    const took = painter.finished();
    if (took > 0) learnFrom(took);
    if (!painter.busy && !sorter.asked) {
      const share = state.playing || swayedFor < Infinity || touching.size || now - changedAt < REST ? quality : 1;
      const fine = !stale && drawnQuality >= share;
      canvas.dataset.settled = fine && share === 1;
      if (!fine && blocks.ready(state.frame)) requestPicture(share);
    }
    requestAnimationFrame(tick);
  };
  requestAnimationFrame(tick);
}

async function start() {
  pageWindow = new PageWindow(document.body);
  describe();
  tellWhere();
  setFree(false);
  if (!("DecompressionStream" in window)) {
    throw new Error("This browser cannot unpack the scene. Chrome or Edge 80, Firefox 113, Safari 16.4 or later can.");
  }
  blocks = new Blocks(about, bytesOfBase64(byId("data").textContent), (share) => {
    if (!painter) byId("message").firstElementChild.textContent = `Unpacking… ${Math.round(100 * share)} %`;
  });
  byId("data").remove();
  await blocks.load(state.frame);
  painter = new Painter(canvas, about);
  measuring = new Measuring(blocks);
  sorter = new Sorter(drawAnswer);
  connect();
  stage.removeAttribute("aria-busy");
  run();
}

start().catch(failWith);
