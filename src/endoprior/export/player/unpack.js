// From the text in the page to 16-bit integers. The coding is described in export/html_data.py.

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
// Returns integers frame by frame: value of Gaussian n in frame t at [t * numGaussians + n]; one frame for order 0.
function undoPrediction(bytes, order, numFrames, numGaussians) {
  const frames = order === 0 ? 1 : numFrames;
  const size = frames * numGaussians;
  if (bytes.length !== 2 * size) throw new Error(`expected ${2 * size} bytes in a channel; got ${bytes.length}`);
  const values = new Uint16Array(size);
  for (let n = 0, i = 0; n < numGaussians; n++) {
    let value = bytes[i] | (bytes[size + i] << 8);
    let speed = 0;
    i++;
    values[n] = value;
    for (let t = 1; t < frames; t++, i++) {
      const code = bytes[i] | (bytes[size + i] << 8);
      const residual = (code >>> 1) ^ -(code & 1);
      speed = order === 2 ? speed + residual : residual;
      value += speed;
      values[t * numGaussians + n] = value;
    }
  }
  return values;
}

// Returns one Uint16Array per channel; progress(share) is called in between.
async function unpack(about, text, progress) {
  const packed = bytesOfBase64(text);
  const planes = [];
  let start = 0;
  for (const channel of about.channels) {
    const bytes = await inflate(packed.subarray(start, start + channel.bytes));
    planes.push(undoPrediction(bytes, channel.order, about.seconds.length, about.gaussians));
    start += channel.bytes;
    progress(planes.length / about.channels.length);
  }
  return planes;
}
