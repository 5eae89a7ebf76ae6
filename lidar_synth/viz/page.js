// Controls, legend and pictures of page.html. page.py packs the data; draw.js draws it.
"use strict";

const data = JSON.parse(document.getElementById("data").textContent);
const $ = (id) => document.getElementById(id);
const home = () => ({ ...data.camera, target: [...data.camera.target] });
const state = { scan: 0, by: data.by, size: 1, boxes: true, turning: false, hidden: new Set(), camera: home() };

const table = bytes(data.table); // one row of 256 colours per quantity
const colour = (row, i) => `rgb(${table.slice((row * 256 + i) * 3, (row * 256 + i) * 3 + 3).join(",")})`;
const shown = () => (data.scans[state.scan].colours.includes(state.by) ? state.by : "height");

function orbit(dx, dy) {
  state.camera.azimuth -= dx * 0.35;
  state.camera.elevation = Math.min(89.9, Math.max(-20, state.camera.elevation + dy * 0.3));
}

function pan(dx, dy) {
  const { right, up } = axes(state.camera);
  const metres = (2 * state.camera.distance * Math.tan((state.camera.field * Math.PI) / 360)) / $("view").clientHeight;
  state.camera.target = state.camera.target.map((t, i) => t - metres * (dx * right[i] - dy * up[i]));
}

function zoom(factor) {
  state.camera.distance = Math.min(400, Math.max(1, state.camera.distance * factor));
}

function listen(canvas) {
  const held = new Map();
  const middle = () => [...held.values()].reduce((sum, p) => [sum[0] + p[0] / held.size, sum[1] + p[1] / held.size], [0, 0]);
  const spread = () => { const [a, b] = [...held.values()]; return Math.hypot(a[0] - b[0], a[1] - b[1]); };
  canvas.addEventListener("pointerdown", (e) => { canvas.setPointerCapture(e.pointerId); held.set(e.pointerId, [e.clientX, e.clientY]); });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (e) => held.delete(e.pointerId));
  canvas.addEventListener("pointermove", (e) => {
    if (!held.has(e.pointerId)) return;
    const before = middle(), wide = held.size === 2 ? spread() : 0;
    held.set(e.pointerId, [e.clientX, e.clientY]);
    const [dx, dy] = middle().map((v, i) => v - before[i]);
    if (held.size === 2) zoom(wide / Math.max(1, spread()));
    if (held.size === 2 || e.shiftKey || e.buttons & 6) pan(dx, dy); else orbit(dx, dy);
    redraw();
  });
  canvas.addEventListener("wheel", (e) => { e.preventDefault(); zoom(Math.exp(e.deltaY * 0.0012)); redraw(); }, { passive: false });
  canvas.addEventListener("contextmenu", (e) => e.preventDefault());
}

function element(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}
const press = (button, on) => button.setAttribute("aria-pressed", on);
function swatch(row, i) { const made = element("i"); made.style.background = colour(row, i); return made; }

function caption() {
  const scan = data.scans[state.scan], domain = element("span", { textContent: data.domains[scan.domain] });
  domain.style.color = colour(data.scales.domain.row, scan.domain);
  $("caption").replaceChildren(
    element("b", { textContent: scan.id }), `${scan.sensor} · `, domain,
    ` · ${scan.count.toLocaleString("en")} points` + (data.scans.length > 1 ? ` · ${state.scan + 1} of ${data.scans.length}` : ""));
}

function legend() {
  const scan = data.scans[state.scan], by = data.scales[shown()];
  if (shown() === "label") {
    const row = element("div", { id: "classes" });
    scan.classes.forEach((count, i) => {
      if (!count) return;
      const share = (100 * count) / scan.count;
      const button = element("button", { title: "show or hide" }, swatch(by.row, Math.min(i, 255)),
        `${data.classes[i]} ${share < 0.1 ? "<0.1" : share.toFixed(1)} %`);
      press(button, !state.hidden.has(i));
      button.onclick = () => { if (!state.hidden.delete(i)) state.hidden.add(i); update(); };
      row.append(button);
    });
    return $("legend").replaceChildren(row);
  }
  if (shown() === "domain") {
    return $("legend").replaceChildren(...data.domains.flatMap((name, i) => [swatch(by.row, i), `${name}  `]));
  }
  const bar = element("div", { className: "bar" });
  bar.style.background = `linear-gradient(to right, ${Array.from({ length: 17 }, (_, k) =>
    colour(by.row, Math.round(255 * (k / 16) ** by.gamma))).join(",")})`;
  const ends = [0, 0.25, 0.5, 0.75, 1].map((f) => element("span", { textContent: (by.low + f * (by.high - by.low)).toFixed(by.high > 20 ? 0 : 1) }));
  return $("legend").replaceChildren(by.title, bar, element("div", { className: "ends" }, ...ends));
}

function pictures() {
  const scan = data.scans[state.scan], facing = ["behind", "left", "ahead", "right", "behind"];
  $("pictures").replaceChildren(...scan.pictures.map(({ title, uri, cells }) => {
    const made = element("figure", { className: cells ? "cells" : "" },
      element("figcaption", { textContent: title }), element("img", { src: uri, alt: `${title}, ${scan.id}` }));
    if (cells) made.append(element("div", { className: "azimuth" }, ...facing.map((f) => element("span", { textContent: f }))));
    return made;
  }));
}

function update() {
  const scan = data.scans[state.scan];
  for (const button of $("colours").children) {
    press(button, button.dataset.by === shown());
    button.hidden = !scan.colours.includes(button.dataset.by);
  }
  [...$("thumbs").children].forEach((thumb, i) => press(thumb, i === state.scan));
  press($("boxes"), state.boxes);
  press($("turn"), state.turning);
  $("boxes").hidden = !scan.boxes;
  $("still").src = scan.still;
  $("still").alt = `${scan.id} in perspective`;
  caption();
  legend();
  redraw();
}

function show(i) {
  state.scan = (i + data.scans.length) % data.scans.length;
  pictures();
  update();
  const thumb = $("thumbs").children[state.scan]; // scrollIntoView would move the page as well
  $("thumbs").scrollLeft = thumb.offsetLeft - ($("thumbs").clientWidth - thumb.clientWidth) / 2;
}

let draw = null, waiting = false;
function redraw() {
  if (!draw || waiting) return;
  waiting = true;
  requestAnimationFrame(() => {
    waiting = false;
    if (state.turning) { state.camera.azimuth += 0.3; }
    const by = data.scales[shown()];
    // Classes are hidden only while the points are coloured by label: otherwise there is no legend to show them again.
    draw(data.scans[state.scan], by, { ...state, empty: data.empty, hidden: shown() === "label" ? state.hidden : [] });
    if (state.turning) redraw();
  });
}

const actions = {
  ArrowLeft: () => show(state.scan - 1), ArrowRight: () => show(state.scan + 1),
  b: () => { state.boxes = !state.boxes; update(); },
  t: () => { state.turning = !state.turning; update(); },
  r: () => { state.camera = home(); redraw(); },
};

function start() {
  for (const [name] of Object.entries(data.scales)) {
    const button = element("button", { textContent: name, onclick: () => { state.by = name; update(); } });
    button.dataset.by = name;
    $("colours").append(button, " ");
  }
  $("size").oninput = (e) => { state.size = +e.target.value; redraw(); };
  $("boxes").onclick = actions.b;
  $("turn").onclick = actions.t;
  $("reset").onclick = actions.r;
  addEventListener("keydown", (e) => {
    if (!actions[e.key] || e.ctrlKey || e.metaKey || e.altKey || e.target.type === "range") return;
    e.preventDefault();
    actions[e.key]();
  });
  $("thumbs").append(...data.scans.map((scan, i) => element("button", { onclick: () => show(i), title: scan.id },
    element("img", { src: scan.still, alt: "", loading: "lazy" }), element("span", { textContent: scan.id }))));
  $("thumbs").hidden = data.scans.length < 2;
  draw = viewer($("view"), table);
  if (draw) { listen($("view")); addEventListener("resize", redraw); }
  for (const id of ["controls", "help", "view"]) $(id).hidden = !draw;
  for (const id of ["still", "warning"]) $(id).hidden = !!draw;
  show(+location.hash.slice(1) || 0);
}

start();
