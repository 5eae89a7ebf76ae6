// Controls, captions, legend and range images of page.html. page.py packs the data; draw.js draws the points.
"use strict";

const data = JSON.parse(document.getElementById("data").textContent);
const $ = (id) => document.getElementById(id);
const startCamera = () => ({ ...data.camera, target: [...data.camera.target] });
const state = { by: data.by, size: 1, boxes: true, turning: false, hidden: new Set(), camera: startCamera(), views: [] };
const UNLABELLED = 19; // index of unlabelled points in data.classes

// ---- data -----------------------------------------------------------------------------------------------------------

function decodeBase64(text) {
  const raw = atob(text), out = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) out[i] = raw.charCodeAt(i);
  return out;
}

// Unpacks the points of a scan, the inverse of `pack` in page.py, and keeps them.
async function load(scan) {
  if (scan.columns) return;
  const stream = new Blob([decodeBase64(scan.points)]).stream().pipeThrough(new DecompressionStream("deflate"));
  const columns = new Uint8Array(await new Response(stream).arrayBuffer()), n = scan.count;
  const places = new Int16Array(columns.buffer, 0, 3 * n);
  for (let axis = 0; axis < 3; axis++) {
    for (let i = axis * n + 1; i < (axis + 1) * n; i++) places[i] += places[i - 1]; // wraps around like int16
  }
  const part = (k) => (columns.length >= (k + 1) * n ? columns.subarray(k * n, (k + 1) * n) : null);
  Object.assign(scan, { columns, places, reflectance: part(6), label: part(7), confidence: part(8) });
}

const table = decodeBase64(data.table); // 256 colours for each quantity
const colour = (row, i) => `rgb(${table.slice((row * 256 + i) * 3, (row * 256 + i) * 3 + 3).join(",")})`;
const quantities = Object.keys(data.scales).filter((name) => name !== "domain"
  && data.scans.some((scan) => scan.colours.includes(name)));
const scanOf = (view) => data.scans[view.scans[view.at]];
const hiddenClasses = () => (state.by === "label" ? state.hidden : new Set()); // only the label legend can show them again

// ---- page elements --------------------------------------------------------------------------------------------------

function element(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}
const press = (button, on) => button.setAttribute("aria-pressed", on);
function swatch(row, i) { const made = element("i"); made.style.background = colour(row, i); return made; }

function caption(view) {
  const scan = scanOf(view), domain = element("b", { textContent: data.domains[scan.domain] });
  domain.style.color = colour(data.scales.domain.row, scan.domain);
  const missing = scan.colours.includes(state.by) ? [] : [element("em", { textContent: `This scan has no ${state.by}.` })];
  view.caption.replaceChildren(domain, element("span", { textContent: `${scan.id} · ${scan.sensor} · ` +
    `${scan.count.toLocaleString("en")} points` + (view.scans.length > 1 ? ` · ${view.at + 1} of ${view.scans.length}` : "") }),
    ...missing);
}

function percent(share) { return share === 0 ? "0" : share < 0.001 ? "<0.1" : (100 * share).toFixed(1); }

function classLegend(scale) {
  const scans = state.views.map(scanOf), labelled = scans.filter((scan) => scan.classes.some((count) => count));
  const row = element("div", { id: "classes" });
  data.classes.forEach((name, i) => {
    if (!labelled.some((scan) => scan.classes[i])) return;
    const shares = labelled.map((scan) => percent(scan.classes[i] / scan.count)).join(" | ");
    const button = element("button", { title: "show or hide" }, swatch(scale.row, i < UNLABELLED ? i : 255), `${name} ${shares} %`);
    press(button, !state.hidden.has(i));
    button.onclick = () => { if (!state.hidden.delete(i)) state.hidden.add(i); update(); };
    row.append(button);
  });
  const order = labelled.length === 2 ? "left | right; " : "";
  return [element("div", { className: "dim", textContent: `share of the points (${order}click a class to hide it)` }), row];
}

function colourBar(scale) {
  const bar = element("div", { className: "bar" });
  bar.style.background = `linear-gradient(to right, ${Array.from({ length: 17 }, (_, k) =>
    colour(scale.row, Math.round(255 * (k / 16) ** scale.gamma))).join(",")})`;
  const marks = [0, 0.25, 0.5, 0.75, 1].map((f) => (scale.low + f * (scale.high - scale.low)).toFixed(scale.high > 20 ? 0 : 1));
  return [scale.title, bar, element("div", { className: "ends" }, ...marks.map((mark) => element("span", { textContent: mark })))];
}

function rangeImages() {
  const facing = ["behind", "left", "ahead", "right", "behind"];
  $("pictures").replaceChildren(...state.views.map((view) => element("div", {}, ...scanOf(view).pictures.map(({ title, uri, cells }) => {
    const made = element("figure", { className: cells ? "cells" : "" },
      element("figcaption", { textContent: `${title}, ${scanOf(view).id}` }), element("img", { src: uri, alt: title }));
    if (cells) made.append(element("div", { className: "azimuth" }, ...facing.map((f) => element("span", { textContent: f }))));
    return made;
  }))));
}

// What is known about the picked point of a view.
function pickedPoint(view) {
  const scan = scanOf(view), i = view.picked;
  view.panel.hidden = view.mark.hidden = i < 0;
  if (i < 0) return;
  const place = pointPosition(scan, i), none = "the scan has none";
  const label = scan.label[i] === 255 ? "unlabelled" : data.classes[scan.label[i]];
  const rows = {
    range: `${Math.hypot(...place).toFixed(2)} m`,
    label: scan.colours.includes("label") ? label : none,
    confidence: scan.confidence ? (scan.confidence[i] / 255).toFixed(2) : none,
    reflectance: (scan.reflectance[i] / 255).toFixed(2),
    "x, y, z": `${place.map((v) => v.toFixed(2)).join(", ")} m`,
  };
  const close = element("button", { textContent: "×", title: "close", onclick: () => pick(view, -1) });
  view.panel.replaceChildren(close, element("dl", {}, ...Object.entries(rows).flatMap(([name, value]) =>
    [element("dt", { textContent: name }), element("dd", { textContent: value })])));
}

function update() {
  for (const button of $("colours").children) press(button, button.dataset.by === state.by);
  press($("boxes"), state.boxes);
  press($("turn"), state.turning);
  $("size").value = state.size;
  for (const view of state.views) {
    caption(view);
    pickedPoint(view);
    [...view.strip.children].forEach((thumb, i) => press(thumb, i === view.at));
    Object.assign(view.still, { src: scanOf(view).still, alt: `${scanOf(view).id} in perspective` });
  }
  const scale = data.scales[state.by];
  $("legend").replaceChildren(...(state.by === "label" ? classLegend(scale) : colourBar(scale)));
  redraw();
}

let waiting = false;
function redraw() {
  if (waiting || !state.views[0].draw) return;
  waiting = true;
  requestAnimationFrame(() => {
    waiting = false;
    if (state.turning) state.camera.azimuth += 0.3;
    for (const view of state.views) drawView(view);
    if (state.turning) redraw();
  });
}

function drawView(view) {
  const scan = scanOf(view);
  if (!scan.columns) return; // it is drawn once it is loaded
  const has = scan.colours.includes(state.by), labels = data.scales.label;
  const scale = has ? { ...data.scales[state.by], quantity: data.scales[state.by].row } : { ...labels, quantity: -1 };
  view.draw(scan, scale, { ...state, hidden: hiddenClasses(), background: data.empty });
  if (view.picked < 0) return;
  const { clientWidth: width, clientHeight: height } = view.canvas;
  const at = projectPoint(perspective(state.camera, width, height), width, height, pointPosition(scan, view.picked));
  view.mark.hidden = !at;
  if (at) Object.assign(view.mark.style, { left: `${at.x}px`, top: `${at.y}px` });
}

// ---- actions --------------------------------------------------------------------------------------------------------

async function show(view, at) {
  view.at = (at + view.scans.length) % view.scans.length;
  view.picked = -1;
  rangeImages();
  update();
  const thumb = view.strip.children[view.at]; // scrollIntoView would move the page as well
  if (thumb) view.strip.scrollLeft = thumb.offsetLeft - (view.strip.clientWidth - thumb.clientWidth) / 2;
  await load(scanOf(view));
  redraw();
}

function pick(view, index) {
  view.picked = index;
  update();
}

function pickAt(view, x, y) {
  const { clientWidth: width, clientHeight: height } = view.canvas, scan = scanOf(view);
  if (scan.columns) pick(view, pickPoint(scan, state.camera, width, height, x, y, state.size, hiddenClasses()));
}

function turn(dx, dy) {
  state.camera.azimuth -= dx * 0.35;
  state.camera.elevation = Math.min(89.9, Math.max(-20, state.camera.elevation + dy * 0.3));
}

function move(dx, dy, height) {
  const { right, up } = cameraAxes(state.camera);
  const metres = (2 * state.camera.distance * Math.tan((state.camera.field * Math.PI) / 360)) / height;
  state.camera.target = state.camera.target.map((t, i) => t - metres * (dx * right[i] - dy * up[i]));
}

function zoom(factor) {
  state.camera.distance = Math.min(400, Math.max(1, state.camera.distance * factor));
}

function resizePoints(factor) {
  state.size = Math.min(3, Math.max(0.3, +(state.size * factor).toFixed(2)));
}

// Mouse and touch on a view. A press that moves less than 4 pixels picks a point.
function listen(view) {
  const canvas = view.canvas, held = new Map();
  let travelled = 0;
  const middle = () => [...held.values()].reduce((sum, p) => [sum[0] + p[0] / held.size, sum[1] + p[1] / held.size], [0, 0]);
  const spread = () => { const [a, b] = [...held.values()]; return Math.hypot(a[0] - b[0], a[1] - b[1]); };
  canvas.addEventListener("pointerdown", (e) => {
    canvas.setPointerCapture(e.pointerId);
    if (!held.size) travelled = 0;
    held.set(e.pointerId, [e.clientX, e.clientY]);
    if (held.size > 1) travelled = Infinity; // two fingers never pick
  });
  canvas.addEventListener("pointermove", (e) => {
    if (!held.has(e.pointerId)) return;
    const before = middle(), wide = held.size === 2 ? spread() : 0;
    held.set(e.pointerId, [e.clientX, e.clientY]);
    const [dx, dy] = middle().map((v, i) => v - before[i]);
    travelled += Math.hypot(dx, dy);
    if (travelled < 4) return;
    if (held.size === 2) zoom(wide / Math.max(1, spread()));
    if (held.size === 2 || e.shiftKey || e.buttons & 6) move(dx, dy, canvas.clientHeight); else turn(dx, dy);
    redraw();
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (e) => {
    const box = canvas.getBoundingClientRect();
    if (end === "pointerup" && held.size === 1 && travelled < 4 && e.button === 0) pickAt(view, e.clientX - box.left, e.clientY - box.top);
    held.delete(e.pointerId);
  });
  canvas.addEventListener("wheel", (e) => { e.preventDefault(); zoom(Math.exp(e.deltaY * 0.0012)); redraw(); }, { passive: false });
  canvas.addEventListener("contextmenu", (e) => e.preventDefault());
}

// The only list of keys: the help shows it and the page obeys it.
function makeKeys() {
  const keys = [];
  const add = (key, shown, does, act, shift = false) => keys.push({ key, shown, does, act, shift });
  quantities.forEach((name, i) => add(`${i + 1}`, `${i + 1}`, `colour by ${name}`, () => { state.by = name; update(); }));
  state.views.forEach((view, i) => {
    if (view.scans.length < 2) return;
    const side = state.views.length > 1 ? ["on the left", "on the right"][i] : "", shift = i > 0 ? "Shift " : "";
    add("ArrowLeft", `${shift}←`, `previous scan ${side}`, () => show(view, view.at - 1), i > 0);
    add("ArrowRight", `${shift}→`, `next scan ${side}`, () => show(view, view.at + 1), i > 0);
  });
  add("+", "+", "larger points", () => { resizePoints(1.25); update(); });
  add("-", "−", "smaller points", () => { resizePoints(0.8); update(); });
  if (data.scans.some((scan) => scan.boxes)) add("b", "b", "boxes on or off", () => { state.boxes = !state.boxes; update(); });
  add("t", "t", "turntable on or off", () => { state.turning = !state.turning; update(); });
  add("r", "r", "reset the camera", () => { state.camera = startCamera(); redraw(); });
  add("Escape", "Esc", "forget the picked points", () => { for (const view of state.views) view.picked = -1; update(); });
  return keys;
}

function pressed(keys, e) {
  if (e.ctrlKey || e.metaKey || e.altKey || e.target.type === "range") return;
  const arrow = e.key.startsWith("Arrow"); // Shift is part of typing a "+", and tells the views apart only for arrows
  const found = keys.find(({ key, shift }) => key === e.key && (!arrow || shift === e.shiftKey));
  if (!found) return;
  e.preventDefault();
  found.act();
}

// ---- start ----------------------------------------------------------------------------------------------------------

function makeView(scans, first) {
  const view = { scans, at: first, picked: -1, caption: element("div", { className: "caption" }), canvas: element("canvas"),
    still: element("img", { className: "still", hidden: true }), panel: element("div", { className: "picked", hidden: true }),
    mark: element("div", { className: "mark", hidden: true }), strip: element("div", { className: "strip", hidden: scans.length < 2 }) };
  $("views").append(element("div", { className: "view" }, view.canvas, view.still, view.mark, view.caption, view.panel));
  $("strips").append(view.strip);
  view.strip.append(...scans.map((number, i) => element("button", { onclick: () => show(view, i), title: data.scans[number].id },
    element("img", { src: data.scans[number].still, alt: "" }), element("span", { textContent: data.scans[number].id }))));
  view.draw = makeViewer(view.canvas, table);
  if (view.draw) listen(view);
  return view;
}

// One view of a single scan; real scans on the left and synthetic ones on the right; or any two scans.
function makeViews() {
  const all = data.scans.map((_, i) => i), ofDomain = [0, 1].map((d) => all.filter((i) => data.scans[i].domain === d));
  if (all.length === 1) return [makeView(all, 0)];
  return ofDomain.every((scans) => scans.length) ? ofDomain.map((scans) => makeView(scans, 0)) : [makeView(all, 0), makeView(all, 1)];
}

function start() {
  state.views = makeViews();
  $("viewer").classList.toggle("two", state.views.length > 1);
  quantities.forEach((name, i) => {
    const button = element("button", { textContent: name, title: `key ${i + 1}`, onclick: () => { state.by = name; update(); } });
    button.dataset.by = name;
    $("colours").append(button);
  });
  const keys = makeKeys(), act = (key) => keys.find((k) => k.key === key)?.act;
  $("size").oninput = (e) => { state.size = +e.target.value; redraw(); };
  $("boxes").onclick = act("b");
  $("boxes").hidden = !act("b");
  $("turn").onclick = act("t");
  $("reset").onclick = act("r");
  addEventListener("keydown", (e) => pressed(keys, e));
  const mouse = [["drag", "turn"], ["Shift drag", "move"], ["wheel", "zoom"], ["click", "values of a point"]];
  $("keys").append(...[...mouse, ...keys.map(({ shown, does }) => [shown, does])].map(([shown, does]) =>
    element("span", {}, element("kbd", { textContent: shown }), ` ${does}`)));
  const drawn = !!state.views[0].draw;
  if (drawn) addEventListener("resize", redraw);
  for (const id of ["controls", "keys", "legend"]) $(id).hidden = !drawn;
  $("warning").hidden = drawn;
  for (const view of state.views) { view.canvas.hidden = !drawn; view.still.hidden = drawn; }
  for (const view of state.views) show(view, view.at);
}

start();
