// Draws Gaussians with WebGL2: summed far to near in half floats, because 8 bits lose what hundreds of faint layers add;
// then shown as colors or depth.

const JACOBIAN_MARGIN = 0.3;

function compile(gl, vertexSource, fragmentSource) {
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertexSource], [gl.FRAGMENT_SHADER, fragmentSource]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) {
      throw new Error(`The graphics driver rejected a shader: ${gl.getShaderInfoLog(shader)}`);
    }
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
    throw new Error(`The graphics driver rejected the shaders: ${gl.getProgramInfoLog(program)}`);
  }
  const places = {};
  for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); i++) {
    const { name } = gl.getActiveUniform(program, i);
    places[name.replace("[0]", "")] = gl.getUniformLocation(program, name);
  }
  return { program, places };
}

// Two triangles a square of 4 vertices. Faster than an instance a square, by far so where the processor draws.
function cornersOfSquares(count) {
  const corners = new Uint32Array(6 * count);
  for (let n = 0; n < count; n++) corners.set([4 * n, 4 * n + 1, 4 * n + 2, 4 * n + 2, 4 * n + 1, 4 * n + 3], 6 * n);
  return corners;
}

class Painter {
  constructor(canvas, about) {
    this.canvas = canvas;
    this.about = about;
    this.gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false });
    if (!this.gl) throw new Error("This browser has no WebGL 2, which draws the scene. Turn on hardware acceleration, or use a recent Chrome, Edge, Firefox or Safari.");
    this.start();
  }

  // Everything that lives on the graphics card; again after it was lost.
  start() {
    const { gl, about } = this;
    this.half = Boolean(gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float"));
    this.splats = compile(gl, SPLAT_VERTEX, SPLAT_FRAGMENT);
    this.screen = compile(gl, SCREEN_VERTEX, SCREEN_FRAGMENT);
    this.corners = gl.createBuffer();
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.corners);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, cornersOfSquares(about.gaussians), gl.STATIC_DRAW);

    this.orderRows = Math.ceil(about.gaussians / ORDER_WIDTH);
    this.order = this.texture(gl.R32UI, ORDER_WIDTH, this.orderRows);
    this.orderTexels = new Uint32Array(this.orderRows * ORDER_WIDTH);
    this.rows = Math.ceil(about.gaussians / GAUSSIANS_PER_ROW);
    this.texels = new Uint16Array(this.rows * GAUSSIANS_PER_ROW * GAUSSIAN_TEXELS * 4);
    this.gaussians = this.texture(gl.RGBA16UI, GAUSSIANS_PER_ROW * GAUSSIAN_TEXELS, this.rows);
    this.smokeSize = about.smoke ? about.smoke.size : [1, 1];
    this.smoke = this.texture(gl.RG16F, this.smokeSize[1], this.smokeSize[0]);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.LINEAR);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
    this.smokeTexels = about.smoke ? bytesOfBase64(about.smoke.texels) : null;
    this.uploaded = -1;
    this.fence = null;
    this.sum = null;
    this.buffer = gl.createFramebuffer();
    gl.disable(gl.DEPTH_TEST);
  }

  texture(format, width, height) {
    const { gl } = this;
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
    return texture;
  }

  resizeSum() {
    const { gl } = this;
    const { width, height } = this.canvas;
    if (this.sum && this.sumWidth === width && this.sumHeight === height) return;
    if (this.sum) gl.deleteTexture(this.sum);
    this.sum = this.texture(this.half ? gl.RGBA16F : gl.RGBA8, width, height);
    [this.sumWidth, this.sumHeight] = [width, height];
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.buffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.sum, 0);
  }

  upload(frame, parts) {
    if (this.uploaded === frame) return;
    const { gl, texels } = this;
    let start = 0;
    for (const { gaussians, values } of parts) {
      CHANNEL_SLOTS.forEach((slot, c) => {
        const own = values[c];
        for (let n = 0, i = start + slot; n < gaussians; n++, i += 4 * GAUSSIAN_TEXELS) texels[i] = own[n];
      });
      start += 4 * GAUSSIAN_TEXELS * gaussians;
    }
    gl.bindTexture(gl.TEXTURE_2D, this.gaussians);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, GAUSSIANS_PER_ROW * GAUSSIAN_TEXELS, this.rows, gl.RGBA_INTEGER, gl.UNSIGNED_SHORT, texels);
    if (this.smokeTexels) this.uploadSmoke(frame);
    this.uploaded = frame;
  }

  uploadSmoke(frame) {
    const { gl } = this;
    const [rows, columns] = this.smokeSize;
    const roots = this.smokeTexels.subarray(2 * rows * columns * frame, 2 * rows * columns * (frame + 1));
    const values = Float32Array.from(roots, (root) => ((root * this.about.smoke.most) / 255) ** 2);
    gl.bindTexture(gl.TEXTURE_2D, this.smoke);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, columns, rows, gl.RG, gl.FLOAT, values);
  }

  // parts: as `Blocks.parts` gives them for that frame; order: indices far to near; depth: show depth, not color; smoke: show it
  draw(frame, parts, order, view, depth, smoke) {
    const { gl } = this;
    if (gl.isContextLost()) return;
    this.resizeSum();
    this.upload(frame, parts);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.buffer);
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.useProgram(this.splats.program);
    this.setView(view, parts, depth);
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, this.order);
    this.orderTexels.set(order);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ORDER_WIDTH, this.orderRows, gl.RED_INTEGER, gl.UNSIGNED_INT, this.orderTexels);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.gaussians);
    gl.drawElements(gl.TRIANGLES, 6 * order.length, gl.UNSIGNED_INT, 0);

    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.disable(gl.BLEND);
    gl.useProgram(this.screen.program);
    gl.uniform1i(this.screen.places.depth, depth ? 1 : 0);
    gl.uniform3fv(this.screen.places.background, this.about.background);
    gl.uniform3fv(this.screen.places.ramp, DEPTH_COLORS.flat().map((v) => v / 255));
    gl.uniform1i(this.screen.places.smoky, smoke ? 1 : 0);
    gl.uniform1i(this.screen.places.smoke, 2);
    gl.activeTexture(gl.TEXTURE2);
    gl.bindTexture(gl.TEXTURE_2D, this.smoke);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.sum);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    this.fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    this.began = performance.now();
    gl.flush();
  }

  get busy() {
    return this.fence !== null && !this.gl.isContextLost();
  }

  // ms that the last image took, once it is complete; else 0.
  finished() {
    const { gl } = this;
    if (!this.busy || gl.getSyncParameter(this.fence, gl.SYNC_STATUS) !== gl.SIGNALED) return 0;
    gl.deleteSync(this.fence);
    this.fence = null;
    return performance.now() - this.began;
  }

  setView(view, parts, depth) {
    const { gl, about } = this;
    const at = this.splats.places;
    const { rotation: r, focal, center, size } = view;
    const perPart = 4 * GAUSSIAN_TEXELS;
    const [low, stepSize] = [new Float32Array(2 * perPart), new Float32Array(2 * perPart)];
    parts.forEach((part, p) => CHANNEL_SLOTS.forEach((slot, c) => {
      low[p * perPart + slot] = part.low[c];
      stepSize[p * perPart + slot] = part.step[c];
    }));
    gl.uniform1i(at.gaussians, 0);
    gl.uniform1i(at.order, 1);
    gl.uniform1i(at.border, parts.length ? parts[0].gaussians : 0);
    gl.uniform4fv(at.low, low);
    gl.uniform4fv(at.stepSize, stepSize);
    gl.uniformMatrix3fv(at.toCamera, true, r);
    gl.uniform3fv(at.origin, view.translation);
    gl.uniform2fv(at.focal, focal);
    gl.uniform2fv(at.center, center);
    gl.uniform2fv(at.size, size);
    gl.uniform2fv(at.depthRange, depth ? about.depth_range : [0, 0]);
    const margin = size.map((length, i) => (JACOBIAN_MARGIN * 0.5 * length) / focal[i]);
    const least = center.map((c, i) => -c / focal[i] - margin[i]);
    const most = center.map((c, i) => (size[i] - c) / focal[i] + margin[i]);
    gl.uniform4fv(at.slopeLimits, [...least, ...most]);
  }
}

// Position of each channel among the 20 numbers of a Gaussian's texels, in the order of `about.channels`.
const CHANNEL_SLOTS = [0, 1, 2, 4, 5, 6, 7, 8, 9, 10, 3, 12, 13, 14, 11, 15, 16, 17, 18, 19];
