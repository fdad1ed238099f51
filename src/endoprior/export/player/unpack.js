// From the text in the page to 16-bit integers. The coding is described in export/html.py.

function bytesOfBase64(text) {
  const characters = atob(text);
  const bytes = new Uint8Array(characters.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = characters.charCodeAt(i);
  return bytes;
}

async function inflate(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// bytes: a plane of low bytes, then one of high bytes, Gaussian by Gaussian.
// Returns integers step by step: value of Gaussian n in time step t at [t * numGaussians + n]; one step for order 0.
function undoPrediction(bytes, order, steps, numGaussians) {
  const stored = order === 0 ? 1 : steps;
  const size = stored * numGaussians;
  if (bytes.length !== 2 * size) throw new Error(`expected ${2 * size} bytes in a channel; got ${bytes.length}`);
  const values = new Uint16Array(size);
  for (let n = 0, i = 0; n < numGaussians; n++) {
    let value = bytes[i] | (bytes[size + i] << 8);
    let speed = 0;
    i++;
    values[n] = value;
    for (let t = 1; t < stored; t++, i++) {
      const code = bytes[i] | (bytes[size + i] << 8);
      const residual = (code >>> 1) ^ -(code & 1);
      speed = order === 2 ? speed + residual : residual;
      value += speed;
      values[t * numGaussians + n] = value;
    }
  }
  return values;
}

// All channels of a block: {streams, orders, steps, gaussians}, the first two with an entry per channel.
async function unpackBlock({ streams, orders, steps, gaussians }, tell) {
  const planes = [];
  for (const stream of streams) {
    planes.push(undoPrediction(await inflate(stream), orders[planes.length], steps, gaussians));
    tell(planes.length / streams.length);
  }
  return planes;
}
