// The camera that both views share, and the search for the point under the cursor.
"use strict";

const NEAR = 0.2, FAR = 1000; // metres

// Unit vectors: from the target towards the camera, to the right and upwards in the picture.
function cameraAxes(camera) {
  const a = (camera.azimuth * Math.PI) / 180, e = (camera.elevation * Math.PI) / 180;
  return {
    towards: [Math.cos(a) * Math.cos(e), -Math.sin(a) * Math.cos(e), Math.sin(e)],
    right: [Math.sin(a), Math.cos(a), 0],
    up: [-Math.cos(a) * Math.sin(e), Math.sin(a) * Math.sin(e), Math.cos(e)],
  };
}

// matrix: from the scan's frame to clip coordinates, 4 x 4, column by column.
// focal: focal length in pixels of a picture with this height.
function perspective(camera, width, height) {
  const { towards, right, up } = cameraAxes(camera), cot = 1 / Math.tan((camera.field * Math.PI) / 360);
  const eye = camera.target.map((t, i) => t + camera.distance * towards[i]);
  const dot = (axis) => axis[0] * eye[0] + axis[1] * eye[1] + axis[2] * eye[2];
  const depth = [...towards.map((v) => -v), dot(towards)];
  const rows = [
    [...right, -dot(right)].map((v) => (v * cot * height) / width),
    [...up, -dot(up)].map((v) => v * cot),
    depth.map((v, i) => (v * (FAR + NEAR)) / (FAR - NEAR) - (i === 3 ? (2 * FAR * NEAR) / (FAR - NEAR) : 0)),
    depth,
  ];
  return { matrix: new Float32Array([0, 1, 2, 3].flatMap((c) => rows.map((row) => row[c]))), focal: (cot * height) / 2 };
}

function pointPosition(scan, i) {
  return [0, 1, 2].map((axis) => scan.places[axis * scan.count + i] * scan.metres);
}

// Pixel coordinates and depth (metres) of a point in a picture, or null if it is behind the camera.
function projectPoint({ matrix }, width, height, [x, y, z]) {
  const row = (r) => matrix[r] * x + matrix[4 + r] * y + matrix[8 + r] * z + matrix[12 + r];
  const depth = row(3);
  if (depth < NEAR) return null;
  return { x: (row(0) / depth + 1) * width / 2, y: (1 - row(1) / depth) * height / 2, depth };
}

// Radius in pixels of the disc that is drawn for a point; the vertex shader of draw.js has the same formula.
function discRadius(size, range, focal, depth) {
  return Math.min(40, Math.max(1.5 * size, (2 * size * (0.015 + 0.003 * range) * focal) / depth)) / 2;
}

// The index of the point at pixel (x, y), or -1. Among the points whose disc covers the pixel, those within 2 % of the
// smallest depth are visible; of these, the closest one on the screen. If no disc covers the pixel: the closest point
// on the screen, if it is at most REACH pixels away.
const REACH = 8;
function pickPoint(scan, camera, width, height, x, y, size, hidden) {
  const view = perspective(camera, width, height), covering = [];
  let front = Infinity, beside = { index: -1, away: REACH };
  for (let i = 0; i < scan.count; i++) {
    if (hidden.has(Math.min(scan.label[i], 19))) continue;
    const p = pointPosition(scan, i), at = projectPoint(view, width, height, p);
    if (!at) continue;
    const away = Math.hypot(at.x - x, at.y - y);
    if (away > 20 + REACH) continue; // no disc has a larger radius
    if (away <= discRadius(size, Math.hypot(...p), view.focal, at.depth)) {
      covering.push({ index: i, away, depth: at.depth });
      front = Math.min(front, at.depth);
    } else if (away <= beside.away) beside = { index: i, away };
  }
  const visible = covering.filter(({ depth }) => depth <= 1.02 * front).sort((a, b) => a.away - b.away);
  return (visible[0] ?? beside).index;
}
