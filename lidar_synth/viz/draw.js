// WebGL 2 drawing for page.html: points as discs with eye-dome lighting, and lines. It uses no library.
"use strict";

// Vertex and fragment shader of the points. quantity: which value colours them, in the order of VALUES in colour.py;
// -1 = the scan does not have it, and all points get the colour of unlabelled ones.
const POINTS = [`#version 300 es
layout(location=0) in float x; layout(location=1) in float y; layout(location=2) in float z;
layout(location=3) in float reflectance; layout(location=4) in float label; layout(location=5) in float confidence;
uniform mat4 matrix; uniform float metres, size, focal, low, high, gamma, rows; uniform int row, quantity;
uniform uint hidden;
out vec2 place;
void main() {
  vec3 p = vec3(x, y, z) * metres;
  float range = length(p);
  float value = quantity == 0 ? p.z : quantity == 1 ? range : quantity == 2 ? reflectance : quantity == 3 ? label
    : quantity == 4 ? confidence : 255.0;
  uint class_bit = 1u << uint(min(label, 19.0));
  float along = pow(clamp((value - low) / (high - low), 0.0, 1.0), gamma);
  place = vec2((0.5 + 255.0 * along) / 256.0, (float(row) + 0.5) / rows);
  gl_Position = (hidden & class_bit) != 0u ? vec4(0, 0, 2, 1) : matrix * vec4(p, 1);
  gl_PointSize = clamp(2.0 * size * (0.015 + 0.003 * range) * focal / gl_Position.w, 1.5 * size, 40.0);
}`, `#version 300 es
precision highp float;
in vec2 place; uniform sampler2D table; out vec4 colour;
void main() {
  vec2 off = gl_PointCoord - 0.5;
  if (dot(off, off) > 0.25) discard;
  colour = texture(table, place);
}`];

// Eye-dome lighting with the weights of render.py. It also writes the depth, so that points can occlude lines.
const SHADE = [`#version 300 es
void main() { gl_Position = vec4(gl_VertexID == 1 ? 3 : -1, gl_VertexID == 2 ? 3 : -1, 0, 1); }`, `#version 300 es
precision highp float;
uniform sampler2D picture, depth; uniform float near, far; uniform int pixel; uniform vec3 back; out vec4 colour;
float log_depth(ivec2 at) {
  ivec2 last = textureSize(depth, 0) - 1;
  float d = texelFetch(depth, clamp(at, ivec2(0), last), 0).r;
  return d >= 1.0 ? 99.0 : log2(near * far / (far - d * (far - near)));
}
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  float own = log_depth(at), nearer = 0.0;
  gl_FragDepth = texelFetch(depth, at, 0).r;
  if (own > 98.0) { colour = vec4(back, 1); return; }
  for (int i = 0; i < 2; i++) {
    int reach = (i == 0 ? 1 : 3) * pixel;
    nearer += clamp(own - log_depth(at + ivec2(reach, 0)), 0.0, 0.03) + clamp(own - log_depth(at - ivec2(reach, 0)), 0.0, 0.03)
            + clamp(own - log_depth(at + ivec2(0, reach)), 0.0, 0.03) + clamp(own - log_depth(at - ivec2(0, reach)), 0.0, 0.03);
  }
  colour = vec4(mix(back, texelFetch(picture, at, 0).rgb, exp(-40.0 * nearer / 8.0)), 1);
}`];

const LINES = [`#version 300 es
layout(location=0) in vec3 p; uniform mat4 matrix;
void main() { gl_Position = matrix * vec4(p, 1); gl_Position.z -= 0.0005 * gl_Position.w; }`, `#version 300 es
precision highp float; uniform vec4 ink; out vec4 colour; void main() { colour = ink; }`];

// Returns draw(scan, scale, settings), or null if the browser has no WebGL 2.
// table: the colours of all tables, 256 x 3 bytes each.
function makeViewer(canvas, table) {
  const gl = canvas.getContext("webgl2", { antialias: false, alpha: false });
  if (!gl) return null;

  function program([vertex, fragment]) {
    const made = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    const uniforms = new Proxy({}, { get: (known, name) => (known[name] ??= gl.getUniformLocation(made, name)) });
    return { use: () => (gl.useProgram(made), uniforms) };
  }
  const points = program(POINTS), shade = program(SHADE), lines = program(LINES);

  function texture(unit) {
    const made = gl.createTexture();
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, made);
    for (const key of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, key, gl.NEAREST);
    for (const key of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, key, gl.CLAMP_TO_EDGE);
    return made;
  }
  const rows = table.length / 768;
  texture(0);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB8, 256, rows, 0, gl.RGB, gl.UNSIGNED_BYTE, table);
  const picture = texture(1), depth = texture(2), frame = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, picture, 0);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, depth, 0);

  function resize() {
    const scale = Math.min(devicePixelRatio || 1, 2);
    const width = Math.max(1, Math.round(canvas.clientWidth * scale));
    const height = Math.max(1, Math.round(canvas.clientHeight * scale));
    if (canvas.width !== width || canvas.height !== height || !resize.done) {
      [canvas.width, canvas.height, resize.done] = [width, height, true]; // the first time even at the default size
      gl.activeTexture(gl.TEXTURE1);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, width, height, 0, gl.RGBA, gl.UNSIGNED_BYTE, null);
      gl.activeTexture(gl.TEXTURE2);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.DEPTH_COMPONENT24, width, height, 0, gl.DEPTH_COMPONENT, gl.UNSIGNED_INT, null);
    }
    return scale;
  }

  // A vertex array; each attribute is [number of components, type, normalised, stride, offset].
  function vertexArray(content, attributes) {
    const made = gl.createVertexArray();
    gl.bindVertexArray(made);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, content, gl.STATIC_DRAW);
    attributes.forEach(([...layout], location) => {
      gl.enableVertexAttribArray(location);
      gl.vertexAttribPointer(location, ...layout);
    });
    return made;
  }

  const uploaded = new WeakMap(); // scan: its buffers on the graphics card
  function upload(scan) {
    if (uploaded.has(scan)) return uploaded.get(scan);
    const n = scan.count;
    const lines = (content) => ({ array: vertexArray(content, [[3, gl.FLOAT, false, 12, 0]]), count: content.length / 12 });
    const column = (offset, normalised) => [1, gl.UNSIGNED_BYTE, normalised, 1, offset];
    const buffers = {
      points: vertexArray(scan.columns, [
        ...[0, 1, 2].map((axis) => [1, gl.SHORT, false, 2, axis * 2 * n]),
        column(6 * n, true), column(7 * n, false), ...(scan.confidence ? [column(8 * n, true)] : []),
      ]),
      boxes: lines(decodeBase64(scan.boxes)), rings: lines(decodeBase64(scan.rings)),
    };
    uploaded.set(scan, buffers);
    return buffers;
  }

  function drawLines({ array, count }, ink, matrix) {
    const uniforms = lines.use();
    gl.bindVertexArray(array);
    gl.uniformMatrix4fv(uniforms.matrix, false, matrix);
    for (const [test, opacity] of [[gl.LEQUAL, 1], [gl.GREATER, 0.25]]) { // lines behind points are drawn faintly
      gl.depthFunc(test);
      gl.uniform4f(uniforms.ink, ink[0], ink[1], ink[2], ink[3] * opacity);
      gl.drawArrays(gl.LINES, 0, count);
    }
    gl.depthFunc(gl.LESS);
  }

  // scale: {quantity, row, low, high, gamma}, the colour scale; settings: camera, size of the points, whether to show
  // boxes, set of hidden classes, background colour.
  return function draw(scan, scale, { camera, size, boxes, hidden, background }) {
    const buffers = upload(scan), perPixel = resize(); // device pixels per CSS pixel
    const { matrix, focal } = perspective(camera, canvas.width, canvas.height);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.enable(gl.DEPTH_TEST);
    gl.depthMask(true);
    gl.disable(gl.BLEND);
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);

    let uniforms = points.use();
    gl.uniformMatrix4fv(uniforms.matrix, false, matrix);
    for (const [name, value] of Object.entries({ metres: scan.metres, size: size * perPixel, focal: focal / perPixel,
      low: scale.low, high: scale.high, gamma: scale.gamma, rows })) gl.uniform1f(uniforms[name], value);
    gl.uniform1i(uniforms.row, scale.row);
    gl.uniform1i(uniforms.quantity, scale.quantity);
    gl.uniform1i(uniforms.table, 0);
    gl.uniform1ui(uniforms.hidden, [...hidden].reduce((mask, i) => mask | (1 << i), 0) >>> 0);
    gl.bindVertexArray(buffers.points);
    gl.drawArrays(gl.POINTS, 0, scan.count);

    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.depthFunc(gl.ALWAYS);
    uniforms = shade.use();
    gl.uniform1i(uniforms.picture, 1);
    gl.uniform1i(uniforms.depth, 2);
    gl.uniform1i(uniforms.pixel, Math.max(1, Math.round(perPixel)));
    gl.uniform1f(uniforms.near, NEAR);
    gl.uniform1f(uniforms.far, FAR);
    gl.uniform3f(uniforms.back, ...background.map((v) => v / 255));
    gl.drawArrays(gl.TRIANGLES, 0, 3);

    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.depthMask(false);
    drawLines(buffers.rings, [0.6, 0.63, 0.7, 0.35], matrix);
    if (boxes) drawLines(buffers.boxes, [1, 1, 1, 0.9], matrix);
  };
}
