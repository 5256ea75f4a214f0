/** Short ways to make what WebGL works with: programs, textures, framebuffers. */
import {BATCH, WIDTH} from "./shaders.js";

/** Compile a program; `at` has the places of its uniforms. */
export function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS) && !gl.isContextLost()) {
    const logs = gl.getAttachedShaders(made).map((shader) => gl.getShaderInfoLog(shader));
    throw new Error(`The graphics driver refused a shader: ${[gl.getProgramInfoLog(made), ...logs].join(" ")}`);
  }
  const at = {};
  for (let k = 0; k < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); k++) {
    const {name} = gl.getActiveUniform(made, k);
    at[name] = gl.getUniformLocation(made, name);
  }
  return {program: made, at};
}

/** Give a program its textures; those that it does not use are left out. */
export function bind(gl, {at}, textures) {
  let unit = 0;
  for (const [name, made] of Object.entries(textures)) {
    if (!(name in at)) continue;
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, made);
    gl.uniform1i(at[name], unit++);
  }
}

/** The corners of `BATCH` rectangles as triangles. */
export function rectangles(gl) {
  const made = gl.createVertexArray();
  gl.bindVertexArray(made);
  const corners = Uint16Array.from({length: 6 * BATCH}, (_, k) => 4 * Math.floor(k / 6) + [0, 1, 2, 2, 1, 3][k % 6]);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
  gl.bindVertexArray(null);
  return made;
}

/** Triangles, or points without `faces`: {places: float32, colors: uint8, faces?: uint32}, each in base64. */
export function solid(gl, {places, colors, faces}) {
  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const made = gl.createVertexArray();
  gl.bindVertexArray(made);
  const sent = (kind, text) => {
    gl.bindBuffer(kind, gl.createBuffer());
    gl.bufferData(kind, bytes(text), gl.STATIC_DRAW);
    return gl.getBufferParameter(kind, gl.BUFFER_SIZE);
  };
  const points = sent(gl.ARRAY_BUFFER, places) / 12;
  gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
  sent(gl.ARRAY_BUFFER, colors);
  gl.vertexAttribPointer(1, 3, gl.UNSIGNED_BYTE, true, 0, 0);
  [0, 1].forEach((at) => gl.enableVertexAttribArray(at));
  const corners = faces ? sent(gl.ELEMENT_ARRAY_BUFFER, faces) / 4 : 0;
  gl.bindVertexArray(null);
  return {made, points, corners};
}

/** An empty texture without mipmaps. */
export function texture(gl, format, width, height, filter = gl.NEAREST) {
  const made = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, made);
  gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, filter);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, filter);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
  return made;
}

/** A texture with one texel for each Gaussian. */
export function sheet(gl, format, count, values) {
  const made = texture(gl, format, WIDTH, Math.ceil(count / WIDTH));
  if (values) fill(gl, made, format, values);
  return made;
}

/** A texture of one row of colours. */
export function row(gl, values) {
  const made = texture(gl, gl.RGBA8, values.length / 4, 1);
  gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, values.length / 4, 1, gl.RGBA, gl.UNSIGNED_BYTE, values);
  return made;
}

/** Write values into a sheet: the full rows, then the rest. */
export function fill(gl, made, format, values, top = 0) {
  const [layout, type, channels] = {
    [gl.RGBA32UI]: [gl.RGBA_INTEGER, gl.UNSIGNED_INT, 4],
    [gl.RG32UI]: [gl.RG_INTEGER, gl.UNSIGNED_INT, 2],
    [gl.R32UI]: [gl.RED_INTEGER, gl.UNSIGNED_INT, 1],
    [gl.R32I]: [gl.RED_INTEGER, gl.INT, 1],
    [gl.R16I]: [gl.RED_INTEGER, gl.SHORT, 1],
    [gl.R8UI]: [gl.RED_INTEGER, gl.UNSIGNED_BYTE, 1],
    [gl.R32F]: [gl.RED, gl.FLOAT, 1],
    [gl.RGBA8]: [gl.RGBA, gl.UNSIGNED_BYTE, 4],
  }[format];
  const full = Math.floor(values.length / channels / WIDTH);
  const rest = values.length / channels - full * WIDTH;
  gl.bindTexture(gl.TEXTURE_2D, made);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  if (full) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, top, WIDTH, full, layout, type, values);
  if (rest) {
    const last = values.subarray(full * WIDTH * channels);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, top + full, rest, 1, layout, type, last);
  }
}

/** A framebuffer of textures and, if there is one, a depth buffer. */
export function frame(gl, textures, depth = null) {
  const made = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, made);
  const places = textures.map((_, k) => gl.COLOR_ATTACHMENT0 + k);
  places.forEach((place, k) => gl.framebufferTexture2D(gl.FRAMEBUFFER, place, gl.TEXTURE_2D, textures[k], 0));
  if (depth) gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, depth);
  gl.drawBuffers(places.length ? places : [gl.NONE]);
  return made;
}
