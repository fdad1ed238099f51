// The blocks of the data, one for each window of the scene. Few are unpacked at a time: those that are shown, the one
// that follows them, so that playing does not wait at a border, and the one before.

class Blocks {
  // packed: the streams of all blocks; progress(share of a block) is called while one is unpacked
  constructor(about, packed, progress) {
    this.blocks = about.blocks;
    this.packed = packed;
    this.progress = progress;
    this.starts = [];
    let start = 0;
    for (const { channels } of this.blocks) {
      this.starts.push(start);
      start += channels.reduce((sum, channel) => sum + channel.bytes, 0);
    }
    this.planes = this.blocks.map(() => null); // for each block that is unpacked a Uint16Array per channel
    this.wanted = []; // numbers of blocks, the most urgent first
    this.wantedFor = -1; // time step
    this.unpacking = false;
    this.aside = new Aside(unpackBlock, [inflate, undoPrediction]);
  }

  // Numbers of the blocks that time step `frame` shows: one, or two where windows overlap.
  shown(frame) {
    return [...this.blocks.keys()].filter((k) => frame >= this.blocks[k].first && frame < this.end(k));
  }

  end(k) {
    return this.blocks[k].first + this.blocks[k].steps;
  }

  ready(frame) {
    return this.shown(frame).every((k) => this.planes[k]);
  }

  // What a time step that is ready shows: {gaussians, low, step, values} of each block, the last three per channel.
  parts(frame) {
    return this.shown(frame).map((k) => {
      const { first, gaussians, channels } = this.blocks[k];
      const values = this.planes[k].map((plane) => {
        const start = plane.length > gaussians ? (frame - first) * gaussians : 0;
        return plane.subarray(start, start + gaussians);
      });
      return { gaussians, low: channels.map((c) => c.low), step: channels.map((c) => c.step), values };
    });
  }

  // The time step at which what is followed changes from block k to the next: the middle of what both show; null where
  // no time step shows both.
  border(k) {
    if (k < 0 || k + 1 >= this.blocks.length) return null;
    const next = this.blocks[k + 1].first;
    return next < this.end(k) ? Math.ceil((next + this.end(k) - 1) / 2) : null;
  }

  // The block whose Gaussians carry a point at a time step.
  home(frame) {
    return [...this.blocks.keys()].filter((k) => frame >= (this.border(k - 1) ?? this.blocks[k].first)).pop();
  }

  // The planes of a block, which need not be one of those in memory.
  async borrow(k) {
    if (this.planes[k]) return this.planes[k];
    this.lent ??= new Aside(unpackBlock, [inflate, undoPrediction]);
    return this.lent.call(this.packedBlock(k));
  }

  // Unpacks the blocks of a time step, and no other.
  load(frame) {
    this.wanted = this.shown(frame);
    return this.unpack();
  }

  // Unpacks the blocks of a time step and the one that follows, and drops those that are far from it.
  async want(frame) {
    if (frame === this.wantedFor) return;
    this.wantedFor = frame;
    const shown = this.shown(frame);
    const following = Math.max(0, this.blocks.findIndex(({ first }) => first > frame)); // after the last one the first
    this.wanted = [...new Set([...shown, following])];
    const kept = shown.length === 1 ? [...this.wanted, shown[0] - 1] : this.wanted;
    this.planes = this.planes.map((planes, k) => (kept.includes(k) ? planes : null));
    await this.unpack();
  }

  async unpack() {
    if (this.unpacking) return;
    this.unpacking = true;
    const missing = () => this.wanted.find((k) => !this.planes[k]);
    for (let k = missing(); k !== undefined; k = missing()) {
      const planes = await this.aside.call(this.packedBlock(k), this.progress);
      if (this.wanted.includes(k)) this.planes[k] = planes; // else another time was chosen meanwhile
    }
    this.unpacking = false;
  }

  packedBlock(k) {
    const { steps, gaussians, channels } = this.blocks[k];
    let end = this.starts[k];
    const streams = channels.map(({ bytes }) => this.packed.slice(end, (end += bytes)));
    return { streams, orders: channels.map(({ order }) => order), steps, gaussians };
  }
}
