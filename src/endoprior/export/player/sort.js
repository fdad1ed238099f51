// Order of rendering: far to near, by camera z of the centers, in a worker where the browser allows one.

// parts: for each block {centers, weights}: integers of x, y, z, and z = weights . (x, y, z, 1) of those integers.
// Returns the indices of Gaussians beyond nearZ, the farthest first; those of the second block are counted on from the
// first. Counting sort over 2**16 bins; stable.
function sortFarToNear({ parts, nearZ }) {
  const numGaussians = parts.reduce((sum, { centers }) => sum + centers[0].length, 0);
  const depth = new Float32Array(numGaussians);
  let from = 0;
  for (const { centers: [xs, ys, zs], weights: [a, b, c, d] } of parts) {
    for (let n = 0; n < xs.length; n++) depth[from + n] = a * xs[n] + b * ys[n] + c * zs[n] + d;
    from += xs.length;
  }
  let least = Infinity;
  let most = -Infinity;
  for (const z of depth) {
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
  constructor(answered) {
    this.answered = answered; // (order, question)
    this.asked = null;
    this.waiting = null;
    this.aside = new Aside(sortFarToNear);
  }

  // question: {parts, view, nearZ, ...}, handed back with the answer
  async ask(question) {
    if (this.asked) {
      this.waiting = question;
      return;
    }
    this.asked = question;
    const { parts, view, nearZ } = question;
    // Copies: a view would be sent with all that lies behind it.
    const sorted = parts.map((part) => ({
      centers: part.values.slice(0, 3).map((values) => values.slice()),
      weights: depthWeights(part, view),
    }));
    const order = await this.aside.call({ parts: sorted, nearZ });
    const next = this.waiting;
    this.asked = this.waiting = null;
    this.answered(order, question);
    if (next) await this.ask(next);
  }
}
