// Drawing for page.html in WebGL 2: points as discs, eye-dome lighting, lines. No library.
"use strict";

function bytes(text) {
  const raw = atob(text), out = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) out[i] = raw.charCodeAt(i);
  return out;
}

const POINTS = [`#version 300 es
layout(location=0) in vec3 cell; layout(location=1) in vec2 extra;
uniform mat4 matrix; uniform float metres, size, focal, low, high, gamma; uniform int row, domain; uniform uint hidden;
out vec2 place;
void main() {
  vec3 p = cell * metres;
  float range = length(p);
  float value = row == 0 ? p.z : row == 1 ? range : row == 2 ? extra.x / 255.0 : row == 3 ? extra.y : float(domain);
  uint bit = 1u << uint(min(extra.y, 19.0));
  place = vec2((0.5 + 255.0 * pow(clamp((value - low) / (high - low), 0.0, 1.0), gamma)) / 256.0, (float(row) + 0.5) / 5.0);
  gl_Position = (hidden & bit) != 0u ? vec4(0, 0, 2, 1) : matrix * vec4(p, 1);
  gl_PointSize = clamp(2.0 * size * (0.015 + 0.003 * range) * focal / gl_Position.w, 1.5 * size, 40.0);
}`, `#version 300 es
precision highp float;
in vec2 place; uniform sampler2D table; out vec4 colour;
void main() {
  vec2 off = gl_PointCoord - 0.5;
  if (dot(off, off) > 0.25) discard;
  colour = texture(table, place);
}`];

// Eye-dome lighting with the weights of render.py; it also writes the depth, so that points can occlude lines.
const SHADE = [`#version 300 es
void main() { gl_Position = vec4(gl_VertexID == 1 ? 3 : -1, gl_VertexID == 2 ? 3 : -1, 0, 1); }`, `#version 300 es
precision highp float;
uniform sampler2D picture, depth; uniform float near, far; uniform int pixel; uniform vec3 back; out vec4 colour;
float logs(ivec2 at) {
  ivec2 last = textureSize(depth, 0) - 1;
  float d = texelFetch(depth, clamp(at, ivec2(0), last), 0).r;
  return d >= 1.0 ? 99.0 : log2(near * far / (far - d * (far - near)));
}
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  float own = logs(at), behind = 0.0;
  gl_FragDepth = texelFetch(depth, at, 0).r;
  if (own > 98.0) { colour = vec4(back, 1); return; }
  for (int i = 0; i < 2; i++) {
    int reach = (i == 0 ? 1 : 3) * pixel;
    behind += clamp(own - logs(at + ivec2(reach, 0)), 0.0, 0.03) + clamp(own - logs(at - ivec2(reach, 0)), 0.0, 0.03)
            + clamp(own - logs(at + ivec2(0, reach)), 0.0, 0.03) + clamp(own - logs(at - ivec2(0, reach)), 0.0, 0.03);
  }
  colour = vec4(mix(back, texelFetch(picture, at, 0).rgb, exp(-40.0 * behind / 8.0)), 1);
}`];

const LINES = [`#version 300 es
layout(location=0) in vec3 p; uniform mat4 matrix;
void main() { gl_Position = matrix * vec4(p, 1); gl_Position.z -= 0.0005 * gl_Position.w; }`, `#version 300 es
precision highp float; uniform vec4 ink; out vec4 colour; void main() { colour = ink; }`];

// Returns draw(scan, by, settings), or null if the browser has no WebGL 2.
function viewer(canvas, table) {
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
  texture(0);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB8, 256, 5, 0, gl.RGB, gl.UNSIGNED_BYTE, table);
  const picture = texture(1), depth = texture(2), frame = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, picture, 0);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, depth, 0);

  function resize() {
    const scale = Math.min(devicePixelRatio || 1, 2);
    const width = Math.max(1, Math.round(canvas.clientWidth * scale));
    const height = Math.max(1, Math.round(canvas.clientHeight * scale));
    if (canvas.width !== width || canvas.height !== height || !resize.done) {
      [canvas.width, canvas.height, resize.done] = [width, height, true];
      gl.activeTexture(gl.TEXTURE1);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, width, height, 0, gl.RGBA, gl.UNSIGNED_BYTE, null);
      gl.activeTexture(gl.TEXTURE2);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.DEPTH_COMPONENT24, width, height, 0, gl.DEPTH_COMPONENT, gl.UNSIGNED_INT, null);
    }
    return scale;
  }

  function array(content, attributes) {
    const made = gl.createVertexArray();
    gl.bindVertexArray(made);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, content, gl.STATIC_DRAW);
    attributes.forEach(([count, type, stride, offset], place) => {
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, count, type, false, stride, offset);
    });
    return made;
  }
  function upload(scan) {
    if (scan.buffers) return scan.buffers;
    const line = (text) => {
      const content = bytes(text);
      return { array: array(content, [[3, gl.FLOAT, 12, 0]]), count: content.length / 12 };
    };
    scan.buffers = {
      points: array(bytes(scan.points), [[3, gl.SHORT, 8, 0], [2, gl.UNSIGNED_BYTE, 8, 6]]),
      boxes: line(scan.boxes), rings: line(scan.rings),
    };
    return scan.buffers;
  }

  function drawLines(line, ink, matrix) {
    const at = lines.use();
    gl.bindVertexArray(line.array);
    gl.uniformMatrix4fv(at.matrix, false, matrix);
    for (const [test, share] of [[gl.LEQUAL, 1], [gl.GREATER, 0.25]]) { // lines behind points are drawn faintly
      gl.depthFunc(test);
      gl.uniform4f(at.ink, ink[0], ink[1], ink[2], ink[3] * share);
      gl.drawArrays(gl.LINES, 0, line.count);
    }
    gl.depthFunc(gl.LESS);
  }

  return function draw(scan, by, { camera, size, boxes, hidden, empty }) {
    const buffers = upload(scan), scale = resize(), [near, far] = [0.2, 1000];
    const { matrix, focal } = look(camera, canvas.width, canvas.height, near, far);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.enable(gl.DEPTH_TEST);
    gl.depthMask(true);
    gl.disable(gl.BLEND);
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);

    let at = points.use();
    gl.uniformMatrix4fv(at.matrix, false, matrix);
    for (const [name, value] of Object.entries({ metres: scan.metres, size: size * scale, focal: focal / scale,
      low: by.low, high: by.high, gamma: by.gamma })) gl.uniform1f(at[name], value);
    gl.uniform1i(at.row, by.row);
    gl.uniform1i(at.domain, scan.domain);
    gl.uniform1i(at.table, 0);
    gl.uniform1ui(at.hidden, [...hidden].reduce((mask, i) => mask | (1 << i), 0) >>> 0);
    gl.bindVertexArray(buffers.points);
    gl.drawArrays(gl.POINTS, 0, scan.count);

    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.depthFunc(gl.ALWAYS);
    at = shade.use();
    gl.uniform1i(at.picture, 1);
    gl.uniform1i(at.depth, 2);
    gl.uniform1i(at.pixel, Math.max(1, Math.round(scale)));
    gl.uniform1f(at.near, near);
    gl.uniform1f(at.far, far);
    gl.uniform3f(at.back, ...empty.map((v) => v / 255));
    gl.drawArrays(gl.TRIANGLES, 0, 3);

    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.depthMask(false);
    drawLines(buffers.rings, [0.6, 0.63, 0.7, 0.35], matrix);
    if (boxes) drawLines(buffers.boxes, [1, 1, 1, 0.9], matrix);
  };
}

function axes(camera) {
  const a = (camera.azimuth * Math.PI) / 180, e = (camera.elevation * Math.PI) / 180;
  const out = [Math.cos(a) * Math.cos(e), -Math.sin(a) * Math.cos(e), Math.sin(e)];
  const right = [Math.sin(a), Math.cos(a), 0];
  const up = [-Math.cos(a) * Math.sin(e), Math.sin(a) * Math.sin(e), Math.cos(e)];
  return { out, right, up };
}

function look(camera, width, height, near, far) {
  const { out, right, up } = axes(camera), cot = 1 / Math.tan((camera.field * Math.PI) / 360);
  const eye = camera.target.map((t, i) => t + camera.distance * out[i]);
  const along = (axis) => axis[0] * eye[0] + axis[1] * eye[1] + axis[2] * eye[2];
  const rows = [
    [...right, -along(right)].map((v) => (v * cot * height) / width),
    [...up, -along(up)].map((v) => v * cot),
    [...out.map((v) => -v), along(out)].map((v, i) => (v * (far + near)) / (far - near) - (i === 3 ? (2 * far * near) / (far - near) : 0)),
    [...out.map((v) => -v), along(out)],
  ];
  return { matrix: new Float32Array([0, 1, 2, 3].flatMap((c) => rows.map((row) => row[c]))), focal: (cot * height) / 2 };
}
