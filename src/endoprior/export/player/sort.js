// Order of rendering: far to near, by camera z of the centers, in a worker where the browser allows one.

// planes: integers of x, y, z, each with one frame or all of them; weights: z = weights . (x, y, z, 1) in integers.
// Returns the indices of Gaussians beyond nearZ, the farthest first. Counting sort over 2**16 bins; stable.
function sortFarToNear(planes, numGaussians, frame, weights, nearZ) {
  const [xs, ys, zs] = planes.map((plane) => {
    const start = plane.length > numGaussians ? frame * numGaussians : 0;
    return plane.subarray(start, start + numGaussians);
  });
  const [a, b, c, d] = weights;
  const depth = new Float32Array(numGaussians);
  let least = Infinity;
  let most = -Infinity;
  for (let n = 0; n < numGaussians; n++) {
    const z = a * xs[n] + b * ys[n] + c * zs[n] + d;
    depth[n] = z;
    if (z > nearZ) {
      if (z < least) least = z;
      if (z > most) most = z;
    }
  }
  if (!(most >= least)) return new Uint32Array(0);
  const last = 65535;
  const scale = most > least ? last / (most - least) : 0;
  const bin = new Uint16Array(numGaussians);
  const starts = new Uint32Array(last + 2);
  for (let n = 0; n < numGaussians; n++) {
    if (!(depth[n] > nearZ)) continue;
    bin[n] = Math.min(last, Math.max(0, (most - depth[n]) * scale));
    starts[bin[n] + 1]++;
  }
  for (let i = 0; i <= last; i++) starts[i + 1] += starts[i];
  const order = new Uint32Array(starts[last + 1]);
  for (let n = 0; n < numGaussians; n++) {
    if (depth[n] > nearZ) order[starts[bin[n]]++] = n;
  }
  return order;
}

// Sorts one request at a time; of the requests that arrive meanwhile, only the newest is answered.
class Sorter {
  constructor(planes, numGaussians, answered) {
    this.planes = planes;
    this.numGaussians = numGaussians;
    this.answered = answered; // (order, question)
    this.asked = null;
    this.waiting = null;
    this.worker = this.startWorker();
  }

  startWorker() {
    const source = `${sortFarToNear}
      let planes, numGaussians;
      onmessage = ({ data }) => {
        if (data.planes) { ({ planes, numGaussians } = data); return; }
        const order = sortFarToNear(planes, numGaussians, data.frame, data.weights, data.nearZ);
        postMessage(order, [order.buffer]);
      };`;
    try {
      const address = URL.createObjectURL(new Blob([source], { type: "text/javascript" }));
      const worker = new Worker(address);
      worker.onmessage = ({ data }) => this.finish(data);
      worker.onerror = (event) => {
        event.preventDefault();
        if (this.worker) this.stopWorker();
      };
      worker.postMessage({ planes: this.planes, numGaussians: this.numGaussians });
      return worker;
    } catch (error) {
      return null; // some browsers forbid workers in pages from disk
    }
  }

  stopWorker() {
    this.worker.terminate();
    this.worker = null;
    const { asked, waiting } = this;
    this.asked = this.waiting = null;
    if (waiting || asked) this.ask(waiting || asked);
  }

  // question: {frame, weights, nearZ, ...}, handed back with the answer
  ask(question) {
    if (this.asked) {
      this.waiting = question;
      return;
    }
    this.asked = question;
    const { frame, weights, nearZ } = question;
    if (this.worker) this.worker.postMessage({ frame, weights, nearZ });
    else this.finish(sortFarToNear(this.planes, this.numGaussians, frame, weights, nearZ));
  }

  finish(order) {
    const question = this.asked;
    const next = this.waiting;
    this.asked = this.waiting = null;
    this.answered(order, question);
    if (next) this.ask(next);
  }
}
