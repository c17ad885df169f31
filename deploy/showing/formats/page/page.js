"use strict";
/* Draws a run: `data` holds the scene step by step. Texts come from models and users: they only ever become text nodes. */
const data = JSON.parse(document.getElementById("data").textContent);
const byId = (id) => document.getElementById(id);
const canvas = byId("map"), pen = canvas.getContext("2d");
const shown = { regions: true, names: true, objects: true, places: true, edges: true, path: true, frontiers: false };
const view = { scale: 40, x: 0, y: 0, turned: false };
let scene = null, chosen = null, ink = {}, walls = null, floor = null, paint = null, owners = null, timer = 0;

function element(kind, text, name, parent) {
  const made = document.createElement(kind);
  if (text !== undefined && text !== null) made.textContent = text;
  if (name) made.className = name;
  if (parent) parent.append(made);
  return made;
}
const percent = (share) => `${Math.round(100 * share)} %`;
const rgb = (label) => data.colors[label] || [150, 158, 168];
const css = (color) => `rgb(${color.join(" ")})`;

/* ---- the scene at a step: changes are applied from the first on ---- */
function sceneAt(last) {
  const places = new Map(), edges = new Map();
  let regions = [], objects = [];
  for (const step of data.steps.slice(0, last + 1)) {
    for (const id of step.gone) places.delete(id);
    for (const [id, x, y, z, radius, region, unknown, flags, ...belief] of step.places)
      places.set(id, { id, x, y, z, radius, region, unknown: unknown / 100, predicted: (flags & 1) > 0,
        frontier: (flags & 2) > 0, belief: belief.map((share) => share / 100) });
    for (const [a, b] of step.cut) edges.delete(`${a} ${b}`);
    for (const edge of step.edges) edges.set(`${edge[0]} ${edge[1]}`, edge);
    regions = step.regions || regions;
    objects = step.objects || objects;
  }
  const labels = data.steps.slice(0, last + 1).reduce((known, step) => step.labels || known, []);
  return { places, edges: [...edges.values()], regions, objects, labels, step: data.steps[last] };
}
function beliefOf(region) {
  const sums = scene.labels.map(() => 0);
  let count = 0;
  for (const place of scene.places.values()) if (place.region === region.id) {
    count += 1;
    place.belief.forEach((share, row) => { sums[row] += share; });
  }
  return ranked(sums.map((sum) => sum / Math.max(count, 1)));
}
const ranked = (belief) => scene.labels.map((label, row) => [label, belief[row] || 0]).sort((a, b) => b[1] - a[1]);

/* ---- where things are: world metres to pixels of the canvas ---- */
const pixel = (x, y) => view.turned
  ? [(y - view.y) * view.scale + canvas.width / 2, (x - view.x) * view.scale + canvas.height / 2]
  : [(x - view.x) * view.scale + canvas.width / 2, (view.y - y) * view.scale + canvas.height / 2];
const world = (px, py) => view.turned
  ? [view.x + (py - canvas.height / 2) / view.scale, view.y + (px - canvas.width / 2) / view.scale]
  : [view.x + (px - canvas.width / 2) / view.scale, view.y - (py - canvas.height / 2) / view.scale];
function picture(image, alpha) {
  if (!image) return;
  const { x, y, cell, height } = data.grid, s = view.scale;
  const [px, py] = pixel(x, y + height * cell);
  pen.save();
  if (view.turned) pen.setTransform(0, s * cell, -s * cell, 0, px, py);
  else pen.setTransform(s * cell, 0, 0, s * cell, px, py);
  pen.globalAlpha = alpha;
  pen.imageSmoothingEnabled = s * cell < 6;
  pen.drawImage(image, 0, 0, data.grid.width, data.grid.height);
  pen.restore();
}
function fit() {
  const { x, y, cell, width, height } = data.grid, w = width * cell, h = height * cell;
  view.turned = (w > h) !== (canvas.width > canvas.height) && Math.max(w / h, h / w) > 1.15;
  const [across, down] = view.turned ? [h, w] : [w, h], ratio = devicePixelRatio || 1;
  view.scale = Math.min((canvas.width - 30 * ratio) / across, (canvas.height - 30 * ratio) / down);
  view.x = x + w / 2; view.y = y + h / 2;
  draw();
}
function zoom(factor, px = canvas.width / 2, py = canvas.height / 2) {
  const [x, y] = world(px, py);
  view.scale = Math.min(Math.max(view.scale * factor, 2), 2000);
  const [nx, ny] = world(px, py);
  view.x += x - nx; view.y += y - ny;
  draw();
}

/* ---- the floor: every cell has the colour of the place that owns it ---- */
function divide() {
  const { x, y, cell, width, height } = data.grid, best = new Float32Array(width * height).fill(Infinity);
  owners = new Int32Array(width * height).fill(-1);
  const list = [...scene.places.values()], reach = walls ? 0.25 : 0;
  list.forEach((place, row) => {
    const far = place.radius + reach;
    const left = Math.max(0, Math.floor((place.x - far - x) / cell)), right = Math.min(width - 1, Math.ceil((place.x + far - x) / cell));
    const low = Math.max(0, Math.floor((place.y - far - y) / cell)), high = Math.min(height - 1, Math.ceil((place.y + far - y) / cell));
    for (let j = low; j <= high; j++) for (let i = left; i <= right; i++) {
      const dx = x + (i + 0.5) * cell - place.x, dy = y + (j + 0.5) * cell - place.y, square = dx * dx + dy * dy;
      const cost = square - place.radius * place.radius, at = (height - 1 - j) * width + i;
      if (square <= far * far && cost < best[at]) { best[at] = cost; owners[at] = row; }
    }
  });
  owners.places = list;
  colour();
}
function colour() {
  const { cell, width, height } = data.grid, image = new ImageData(width, height), stripe = Math.max(2, Math.round(0.12 / cell));
  const labels = new Map(scene.regions.map((region) => [region.id, region.label]));
  const colors = owners.places.map((place) => {
    const label = labels.get(place.region), aside = chosen && chosen.kind === "region" && chosen.id !== place.region;
    return [...(label === undefined ? [150, 158, 168] : rgb(label)), label === undefined ? 70 : aside ? 60 : 180];
  });
  owners.forEach((row, at) => {
    if (row < 0) return;
    const striped = owners.places[row].predicted && (at % width + Math.floor(at / width)) % (2 * stripe) < stripe;
    for (let part = 0; part < 4; part++) image.data[4 * at + part] = colors[row][part];
    if (striped) image.data[4 * at + 3] *= 0.55;
  });
  paint = document.createElement("canvas");
  paint.width = width; paint.height = height;
  const brush = paint.getContext("2d");
  brush.putImageData(image, 0, 0);
  if (floor) { brush.globalCompositeOperation = "destination-in"; brush.drawImage(floor, 0, 0, width, height); }
}
function tinted(image, color) {
  if (!image) return null;
  const sheet = document.createElement("canvas");
  sheet.width = image.width; sheet.height = image.height;
  const brush = sheet.getContext("2d");
  brush.drawImage(image, 0, 0);
  brush.globalCompositeOperation = "source-in";
  brush.fillStyle = color;
  brush.fillRect(0, 0, sheet.width, sheet.height);
  return sheet;
}

/* ---- drawing ---- */
let waiting = false;
function draw() {
  if (waiting) return;
  waiting = true;
  requestAnimationFrame(() => { waiting = false; render(); });
}
function render() {
  const ratio = devicePixelRatio || 1;
  pen.setTransform(1, 0, 0, 1, 0, 0);
  pen.clearRect(0, 0, canvas.width, canvas.height);
  picture(ink.floor, 1);
  if (shown.regions) picture(paint, 1);
  picture(ink.walls, 1);
  if (shown.edges) edges(ratio);
  if (shown.objects) objects(ratio);
  if (shown.path) path(ratio);
  if (shown.places) places(ratio);
  if (shown.frontiers) frontiers(ratio);
  highlight(ratio);
  if (shown.names) names(ratio);
  measure(ratio);
}
function line(points, color, width) {
  pen.beginPath();
  points.forEach(([x, y], row) => pen[row ? "lineTo" : "moveTo"](...pixel(x, y)));
  pen.lineWidth = width; pen.strokeStyle = color; pen.lineJoin = pen.lineCap = "round";
  pen.stroke();
}
function edges(ratio) {
  pen.beginPath();
  for (const [a, b] of scene.edges) {
    const one = scene.places.get(a), other = scene.places.get(b);
    if (one && other) { pen.moveTo(...pixel(one.x, one.y)); pen.lineTo(...pixel(other.x, other.y)); }
  }
  pen.lineWidth = ratio; pen.strokeStyle = ink.edge; pen.stroke();
}
function places(ratio) {
  const size = Math.min(2.6, Math.max(1.3, view.scale / ratio / 22)) * ratio;
  pen.beginPath();
  for (const place of scene.places.values()) {
    const [x, y] = pixel(place.x, place.y);
    pen.moveTo(x + size, y); pen.arc(x, y, size, 0, 7);
  }
  pen.fillStyle = ink.dot; pen.fill();
}
function frontiers(ratio) {
  for (const place of scene.places.values()) if (place.frontier) {
    const [x, y] = pixel(place.x, place.y);
    pen.beginPath(); pen.arc(x, y, 5 * ratio, 0, 7);
    pen.lineWidth = 2 * ratio; pen.strokeStyle = ink.opening; pen.stroke();
  }
}
function objects(ratio) {
  for (const item of scene.objects) {
    const [x0, y0, x1, y1] = item.box;
    line([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]], item.label ? ink.box : ink.edge, (item.label ? 1.8 : 1) * ratio);
  }
}
function path(ratio) {
  const points = data.path.slice(0, scene.step.path);
  if (!points.length) return;
  pen.setLineDash([6 * ratio, 6 * ratio]);  // where the robot has been: no route
  line(points, ink.halo, 4.5 * ratio);
  line(points, ink.path, 1.8 * ratio);
  pen.setLineDash([]);
  const [x, y] = pixel(...points[points.length - 1]);
  pen.beginPath(); pen.arc(x, y, 5 * ratio, 0, 7); pen.fillStyle = ink.path; pen.fill();
}
function highlight(ratio) {
  if (!chosen) return;
  if (chosen.kind === "place") {
    const place = scene.places.get(chosen.id);
    if (!place) return;
    pen.beginPath(); pen.arc(...pixel(place.x, place.y), Math.max(place.radius * view.scale, 7 * ratio), 0, 7);
    pen.lineWidth = 3 * ratio; pen.strokeStyle = ink.accent; pen.stroke();
  } else if (chosen.kind === "object") {
    const item = scene.objects.find((one) => one.id === chosen.id);
    if (!item) return;
    const [x0, y0, x1, y1] = item.box;
    line([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]], ink.accent, 3 * ratio);
  }
}
function names(ratio) {
  const taken = [];
  const write = (text, detail, x, y, size, weight) => {
    pen.font = `${weight} ${size * ratio}px system-ui, sans-serif`;
    const width = pen.measureText(text).width, height = size * ratio * (detail ? 2.1 : 1.2);
    const box = [x - width / 2 - 4, y - size * ratio, x + width / 2 + 4, y - size * ratio + height];
    if (taken.some((other) => box[0] < other[2] && box[2] > other[0] && box[1] < other[3] && box[3] > other[1])) return;
    taken.push(box);
    pen.textAlign = "center"; pen.lineJoin = "round"; pen.strokeStyle = ink.halo; pen.fillStyle = ink.ink;
    pen.lineWidth = 4 * ratio; pen.strokeText(text, x, y); pen.fillText(text, x, y);
    if (!detail) return;
    pen.font = `400 ${0.8 * size * ratio}px system-ui, sans-serif`;
    pen.strokeText(detail, x, y + size * ratio); pen.fillText(detail, x, y + size * ratio);
  };
  for (const region of [...scene.regions].sort((a, b) => b.area - a.area))
    write(shortened(region.label, 28), percent(region.probability), ...pixel(region.x, region.y), 15, 650);
  if (shown.path && scene.step.path) {
    const [x, y] = pixel(...data.path[scene.step.path - 1]);
    write("robot", "", x, y + 19 * ratio, 12.5, 600);
  }
  if (shown.objects) for (const item of scene.objects) if (item.label)
    write(shortened(item.label, 22), "", ...pixel((item.box[0] + item.box[2]) / 2, (item.box[1] + item.box[3]) / 2), 11.5, 450);
}
const shortened = (text, length) => [...text].length > length ? `${[...text].slice(0, length - 1).join("")}…` : text;
function measure(ratio) {
  const wanted = (90 * ratio) / view.scale, metres = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500].filter((one) => one <= wanted).pop() || 0.1;
  const x = 16 * ratio, y = canvas.height - 16 * ratio, width = metres * view.scale;
  pen.beginPath(); pen.moveTo(x, y - 4 * ratio); pen.lineTo(x, y); pen.lineTo(x + width, y); pen.lineTo(x + width, y - 4 * ratio);
  pen.lineWidth = 1.5 * ratio; pen.strokeStyle = ink.muted; pen.stroke();
  pen.font = `${12 * ratio}px system-ui, sans-serif`; pen.textAlign = "left"; pen.fillStyle = ink.muted;
  pen.fillText(`${metres} m`, x + 5 * ratio, y - 5 * ratio);
}

/* ---- beside the map ---- */
function bars(belief, parent, most = 8) {
  const grid = element("div", null, "belief", parent);
  for (const [label, share] of belief.slice(0, most)) {
    element("span", label, "", grid).title = label;
    const fill = element("div", null, "fill", element("div", null, "track", grid));
    fill.style.width = `${100 * share}%`;
    fill.style.background = data.colors[label] ? css(rgb(label)) : "";
    element("span", percent(share), "percent", grid);
  }
  if (belief.length > most) element("span", `and ${belief.length - most} more`, "", grid);
}
function row(parent, color, name, value, others, choice) {
  const button = element("button", null, "row", parent);
  button.type = "button";
  const swatch = element("span", null, "swatch", button);
  if (color) swatch.style.background = css(color);
  const title = element("span", name, "name", button);
  element("span", value, "value", button);
  if (others) element("span", others, "others", button);
  button.setAttribute("aria-current", String(chosen !== null && chosen.kind === choice.kind && chosen.id === choice.id));
  button.addEventListener("click", () => choose(choice));
  return title;
}
function list() {
  const box = byId("regions");
  box.replaceChildren();
  for (const region of [...scene.regions].sort((a, b) => b.area - a.area)) {
    const others = beliefOf(region).filter(([label, share]) => label !== region.label && share >= 0.05).slice(0, 2);
    const told = others.map(([label, share]) => `${label} ${percent(share)}`).join(", ");
    const title = row(box, rgb(region.label), region.label, `${percent(region.probability)} · ${region.area.toFixed(1)} m²`,
      told && `or ${told}`, { kind: "region", id: region.id });
    if (region.predicted) element("span", "predicted", "tag", title);
  }
  if (!scene.regions.length) element("p", "none yet", "", box);
  const items = byId("objects"), sorted = [...scene.objects].sort((a, b) => Boolean(b.label) - Boolean(a.label) || b.probability - a.probability);
  items.replaceChildren();
  for (const item of sorted.slice(0, 300))
    row(items, null, item.label || `unnamed object ${item.id}`, item.label ? percent(item.probability) : "", "", { kind: "object", id: item.id });
  byId("object-count").textContent = `(${scene.objects.length})`;
  byId("objects-box").hidden = !scene.objects.length;
}
function choose(choice) {
  chosen = choice;
  colour();
  document.querySelector("aside").scrollTop = 0;
  detail();
  list();
  draw();
}
function detail() {
  const box = byId("chosen");
  box.replaceChildren();
  const told = chosen && { region: regionTold, place: placeTold, object: objectTold }[chosen.kind]();
  box.hidden = !told;
  if (!told) return;
  const head = element("h3", null, "", box);
  const swatch = element("span", null, "swatch", head);
  if (told.color) swatch.style.background = css(told.color);
  element("span", told.title, "", head);
  const close = element("button", "✕", "", head);
  close.setAttribute("aria-label", "close");
  close.addEventListener("click", () => choose(null));
  element("p", told.about, "", box);
  if (told.belief) bars([...told.belief, ["none of these", told.unknown]], box, 9);
  for (const [title, text] of told.lists || []) if (text) { element("h4", title, "", box); element("div", text, "", box); }
}
function regionTold() {
  const region = scene.regions.find((one) => one.id === chosen.id);
  if (!region) return null;
  const label = (id) => (scene.regions.find((one) => one.id === id) || { label: "?" }).label;
  const kept = [...scene.places.values()].filter((place) => place.region === region.id).length;
  const inside = scene.objects.filter((item) => region.objects.includes(item.id) && item.label).map((item) => item.label);
  return {
    title: region.label, color: rgb(region.label), belief: beliefOf(region), unknown: region.unknown,
    about: `region ${region.id}${region.within.map((name) => `, ${name}`).join("")} · ${region.area.toFixed(1)} m² · ${kept} places${region.predicted ? " · predicted from its surroundings" : ""}`,
    lists: [["Objects", inside.join(", ")], ["Ways out", region.ways.map(([to, clearance, door]) =>
      `${door ? "door" : "opening"} to ${label(to)} (${(2 * clearance).toFixed(2)} m wide)`).join(", ")]],
  };
}
function placeTold() {
  const place = scene.places.get(chosen.id);
  if (!place) return null;
  const region = scene.regions.find((one) => one.id === place.region);
  const belief = place.belief.some((share) => share > 0) ? ranked(place.belief) : null;
  return {
    title: `place ${place.id}`, color: region && rgb(region.label), belief, unknown: place.unknown,
    about: `${region ? `in ${region.label} ${region.id}` : "in no region yet"} · x ${place.x.toFixed(2)}, y ${place.y.toFixed(2)}, z ${place.z.toFixed(2)} m · ${place.radius.toFixed(2)} m to the nearest obstacle${place.predicted ? " · predicted" : ""}${place.frontier ? " · beside unseen space" : ""}`,
  };
}
function objectTold() {
  const item = scene.objects.find((one) => one.id === chosen.id);
  if (!item) return null;
  const [x0, y0, x1, y1, z0, z1] = item.box;
  return { title: item.label || `unnamed object ${item.id}`,
    about: `${item.label ? `${percent(item.probability)} · ` : ""}${(x1 - x0).toFixed(2)} × ${(y1 - y0).toFixed(2)} × ${(z1 - z0).toFixed(2)} m · seen in ${item.frames} keyframes` };
}
function table(title, rows) {
  if (!rows.length) return;
  const box = element("details", null, "", byId("more"));
  element("summary", title, "", box);
  const body = element("tbody", null, "", element("table", null, "", box));
  for (const [name, value] of rows) {
    const line = element("tr", null, "", body), head = element("td", name, value === null ? "head" : "", line);
    if (value === null) head.colSpan = 2; else element("td", value, "", line);
  }
}

/* ---- what people do ---- */
function show(step) {
  scene = sceneAt(step);
  divide();
  const { revision, seconds } = scene.step, ends = step === data.steps.length - 1;
  byId("when").textContent = `${seconds.toFixed(1)} s · revision ${revision}${ends ? " · end" : ""}`;
  detail(); list(); draw();
}
function play() {
  const slider = byId("step"), stop = () => { clearInterval(timer); timer = 0; byId("play").textContent = "▶"; };
  if (timer) return stop();
  if (Number(slider.value) >= data.steps.length - 1) slider.value = 0;
  byId("play").textContent = "❚❚";
  timer = setInterval(() => {
    slider.value = Number(slider.value) + 1;
    show(Number(slider.value));
    if (Number(slider.value) >= data.steps.length - 1) stop();
  }, 220);
}
function pick(px, py) {
  const [x, y] = world(px, py), reach = (12 * (devicePixelRatio || 1)) / view.scale;
  let near = null, least = reach;
  if (shown.places) for (const place of scene.places.values()) {
    const distance = Math.hypot(place.x - x, place.y - y);
    if (distance < least) { least = distance; near = place; }
  }
  if (near) return choose({ kind: "place", id: near.id });
  const { x: left, y: low, cell, width, height } = data.grid, i = Math.floor((x - left) / cell), j = Math.floor((y - low) / cell);
  const owner = i >= 0 && j >= 0 && i < width && j < height ? owners[(height - 1 - j) * width + i] : -1;
  const region = owner < 0 ? null : owners.places[owner].region;
  choose(region === null || region < 0 ? null : { kind: "region", id: region });
}
function hands() {
  const fingers = new Map();
  let moved = 0, apart = 0;
  const at = (event) => { const ratio = devicePixelRatio || 1, box = canvas.getBoundingClientRect(); return [(event.clientX - box.left) * ratio, (event.clientY - box.top) * ratio]; };
  canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); fingers.set(event.pointerId, at(event)); moved = apart = 0; });
  canvas.addEventListener("pointermove", (event) => {
    if (!fingers.has(event.pointerId)) return;
    const before = fingers.get(event.pointerId), now = at(event);
    fingers.set(event.pointerId, now);
    if (fingers.size === 1) {
      const [x0, y0] = world(...before), [x1, y1] = world(...now);
      view.x += x0 - x1; view.y += y0 - y1;
      moved += Math.hypot(now[0] - before[0], now[1] - before[1]);
      if (moved > 4) draw();
    } else {
      const [[ax, ay], [bx, by]] = [...fingers.values()], distance = Math.hypot(ax - bx, ay - by);
      moved = 100;
      if (apart) zoom(distance / apart, (ax + bx) / 2, (ay + by) / 2);
      apart = distance;
    }
  });
  canvas.addEventListener("pointerup", (event) => { fingers.delete(event.pointerId); apart = 0; if (moved <= 4) pick(...at(event)); });
  canvas.addEventListener("pointercancel", (event) => { fingers.delete(event.pointerId); apart = 0; });
  canvas.addEventListener("wheel", (event) => { event.preventDefault(); zoom(Math.exp(-event.deltaY / 400), ...at(event)); }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const [dx, dy] = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key] || [0, 0];
    if (event.key === "+") zoom(1.3); else if (event.key === "-") zoom(1 / 1.3); else if (!dx && !dy) return;
    const [x, y] = world(canvas.width / 2 + dx * 60, canvas.height / 2 + dy * 60);
    view.x = x; view.y = y;
    event.preventDefault(); draw();
  });
}
function colours(theme) {
  document.documentElement.dataset.theme = theme;
  const style = getComputedStyle(document.documentElement), of = (name) => style.getPropertyValue(`--${name}`).trim();
  ink = Object.fromEntries(["ink", "muted", "edge", "dot", "path", "halo", "opening", "box", "accent"].map((name) => [name, of(name)]));
  ink.floor = tinted(floor, of("free"));
  ink.walls = tinted(walls, of("wall"));
}
function load(address) {
  return address ? new Promise((done, failed) => { const image = new Image(); image.onload = () => done(image); image.onerror = failed; image.src = address; }) : null;
}
function controls() {
  for (const layer of Object.keys(shown)) {
    const button = element("button", layer === "path" ? "robot's way" : layer, "", byId("layers"));
    button.type = "button";
    button.setAttribute("aria-pressed", String(shown[layer]));
    button.addEventListener("click", () => { shown[layer] = !shown[layer]; button.setAttribute("aria-pressed", String(shown[layer])); draw(); });
  }
  byId("in").addEventListener("click", () => zoom(1.4));
  byId("out").addEventListener("click", () => zoom(1 / 1.4));
  byId("fit").addEventListener("click", fit);
  byId("theme").addEventListener("click", () => { colours(document.documentElement.dataset.theme === "dark" ? "light" : "dark"); draw(); });
  const slider = byId("step");
  slider.max = data.steps.length - 1; slider.value = slider.max;
  slider.addEventListener("input", () => show(Number(slider.value)));
  byId("play").addEventListener("click", play);
  byId("timeline").hidden = data.steps.length < 2;
}
async function start() {
  byId("task").textContent = data.task;
  byId("about").textContent = data.about;
  byId("notes").textContent = data.notes.join(" ");
  for (const [title, rows] of data.tables) table(title, rows);
  controls(); hands();
  [floor, walls] = await Promise.all([load(data.grid.free), load(data.grid.walls)]);
  const dark = matchMedia("(prefers-color-scheme: dark)");
  colours(dark.matches ? "dark" : "light");
  dark.addEventListener("change", () => { colours(dark.matches ? "dark" : "light"); draw(); });
  let fitted = false;
  new ResizeObserver(() => {
    const ratio = devicePixelRatio || 1, box = canvas.getBoundingClientRect();
    canvas.width = Math.round(box.width * ratio); canvas.height = Math.round(box.height * ratio);
    if (fitted) render(); else { fitted = true; fit(); }
  }).observe(canvas);
  show(data.steps.length - 1);
  document.documentElement.dataset.ready = "yes";
}
start();
