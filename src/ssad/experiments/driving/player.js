"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const $ = (id) => document.getElementById(id);
const canvas = $("canvas"), pen = canvas.getContext("2d");
const KIND = { walker: 6, bicycle: 5, motorcycle: 4, prop: 7 };
const LAMP = { 1: "#dc2626", 2: "#eab308", 3: "#22c55e" };
const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
let now = null, time = 0, playing = false, last = 0, follow = true, view = { x: 0, y: 0, scale: 8 }, wanted = "";

// base64 -> zlib -> int16 differences -> columns
async function unpack(text, rows) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  const flat = new Int16Array(await new Response(stream).arrayBuffer());
  const steps = flat.length / rows, out = [];
  for (let r = 0; r < rows; r++) {
    const column = new Int16Array(steps);
    let sum = 0;
    for (let t = 0; t < steps; t++) { sum = (sum + flat[r * steps + t]) << 16 >> 16; column[t] = sum; }
    out.push(column);
  }
  return out;
}

function strips(town) {
  if (town.paths) return town.paths;
  town.paths = town.strips.map(([kind, junction, lines, split, flat]) => {
    const points = [];
    for (let i = 0; i < flat.length; i += 2) points.push([flat[i], flat[i + 1]]);
    const path = new Path2D(), left = new Path2D(), right = new Path2D();
    points.forEach(([x, y], i) => i ? path.lineTo(x, y) : path.moveTo(x, y));
    path.closePath();
    points.slice(0, split).forEach(([x, y], i) => i ? left.lineTo(x, y) : left.moveTo(x, y));
    points.slice(split).forEach(([x, y], i) => i ? right.lineTo(x, y) : right.moveTo(x, y));
    return { kind, junction, lines, path, left, right };
  });
  town.walks = town.crosswalks.map((flat) => {
    const path = new Path2D();
    for (let i = 0; i < flat.length; i += 2) i ? path.lineTo(flat[i], flat[i + 1]) : path.moveTo(flat[i], flat[i + 1]);
    path.closePath();
    return path;
  });
  return town.paths;
}

async function show(key) {
  const episode = data.episodes[key];
  document.querySelectorAll(".matrix .mark").forEach((m) => m.classList.toggle("now", m.dataset.key === key));
  wanted = key;
  if (!episode) {
    now = null; playing = false;
    $("name").textContent = "no replay"; $("subtitle").textContent = data.missing[key] || "the episode failed";
    pen.clearRect(0, 0, canvas.width, canvas.height); button();
    return;
  }
  if (!episode.columns) {
    const agents = episode.names.length;
    episode.words = Math.ceil(agents / 15);
    const [columns, record, route] = await Promise.all([
      unpack(episode.motion, 3 * agents + episode.words), unpack(episode.record, 7), unpack(episode.route, 2)]);
    Object.assign(episode, { columns, table: record, path: route });
  }
  if (wanted !== key) return;  // another one was chosen meanwhile
  now = episode; time = 0; playing = true; follow = true; button();
  $("name").textContent = episode.scenario;
  $("subtitle").textContent = `${episode.system} · ${episode.town} · ${episode.end.replace("_", " ")}`;
  $("verdict").textContent = episode.witness;
  $("seek").max = episode.steps - 1;
  const hit = $("hit"), first = episode.hits[0];
  hit.style.display = first ? "block" : "none";
  if (first) hit.style.left = `calc(8px + (100% - 16px) * ${first[0] / Math.max(episode.steps - 1, 1)})`;
  view.scale = canvas.clientWidth / 90;
  draw();
}

const angle = (v) => v / 32767 * Math.PI;
function pose(a, t) {
  const i = Math.min(Math.floor(t), now.steps - 1), j = Math.min(i + 1, now.steps - 1), f = t - i;
  const c = now.columns, mix = (r) => (c[r][i] + (c[r][j] - c[r][i]) * f) * now.scale;
  const y0 = angle(c[3 * a + 2][i]);
  let turn = angle(c[3 * a + 2][j]) - y0;
  turn -= 2 * Math.PI * Math.round(turn / (2 * Math.PI));
  return [mix(3 * a) + now.anchor[0], mix(3 * a + 1) + now.anchor[1], y0 + turn * f];
}
const present = (a, i) => now.columns[3 * now.names.length + Math.floor(a / 15)][i] >> (a % 15) & 1;

function colour(a) {
  if (a === 0) return css("--s0");
  const kind = now.kinds[a];
  if (kind === KIND.walker) return "#db2777";
  if (kind === KIND.bicycle || kind === KIND.motorcycle) return "#059669";
  return kind === KIND.prop ? "#78716c" : "#ea8a1e";
}

function body(a, t) {
  const [x, y, yaw] = pose(a, t), [length, width] = now.size[a];
  pen.save(); pen.translate(x, y); pen.rotate(yaw);
  pen.fillStyle = colour(a); pen.strokeStyle = "rgba(255,255,255,.9)"; pen.lineWidth = 1.5 / view.scale;
  pen.beginPath();
  const least = 5 / view.scale, l = Math.max(length, least), w = Math.max(width, least);
  if (now.kinds[a] === KIND.walker) pen.arc(0, 0, Math.max(l, w) * 0.6, 0, 7);
  else pen.roundRect(-l / 2, -w / 2, l, w, Math.min(0.5, w / 4));
  pen.fill(); pen.stroke();
  if (now.kinds[a] < KIND.walker) { pen.fillStyle = "rgba(226,232,240,.9)"; pen.fillRect(l * 0.2, -w * 0.38, l * 0.13, w * 0.76); }
  const side = turnSignal(a, t);
  if (side) {
    pen.fillStyle = "#fbbf24"; const r = Math.max(0.35, 3 / view.scale);
    for (const x of [l / 2, -l / 2]) { pen.beginPath(); pen.arc(x, side * w / 2, r, 0, 7); pen.fill(); }
  }
  pen.restore();
}

// 1 left, -1 right, 0 none or dark: 90 flashes a minute
function turnSignal(a, t) {
  const entry = now.turn_signals.find(([agent]) => agent === a);
  let state = 0;
  if (entry) for (const [step, value] of entry[1]) if (step <= t) state = value;
  return Math.floor(t * now.dt * 3) % 2 ? 0 : state;
}

function draw() {
  const ratio = window.devicePixelRatio || 1;
  const wide = Math.round(canvas.clientWidth * ratio), high = Math.round(canvas.clientHeight * ratio);
  if (canvas.width !== wide || canvas.height !== high) { canvas.width = wide; canvas.height = high; }
  pen.setTransform(1, 0, 0, 1, 0, 0);
  pen.fillStyle = css("--ground"); pen.fillRect(0, 0, wide, high);
  if (!now) return;
  const i = Math.min(Math.floor(time), now.steps - 1), town = data.towns[now.town];
  if (follow) { const [x, y, yaw] = pose(0, time); view.x = x + 8 * Math.cos(yaw); view.y = y + 8 * Math.sin(yaw); }
  const s = view.scale * ratio;
  pen.setTransform(s, 0, 0, -s, wide / 2 - view.x * s, high / 2 + view.y * s);
  const fill = [css("--walk"), css("--shoulder"), css("--shoulder"), css("--road")], edge = css("--edge");
  const lanes = strips(town);
  for (const lane of lanes) {
    pen.fillStyle = pen.strokeStyle = fill[lane.kind]; pen.lineWidth = 0.12;
    pen.fill(lane.path); pen.stroke(lane.path);
  }
  pen.fillStyle = "rgba(255,255,255,.16)";
  for (const walk of town.walks) pen.fill(walk);
  for (const lane of lanes) {
    if (lane.kind !== 3) continue;
    for (const [style, path] of [[lane.lines[0], lane.left], [lane.lines[1], lane.right]]) {
      if (!style) continue;
      pen.strokeStyle = style === 3 ? "#eab308" : edge; pen.lineWidth = style === 3 ? 0.22 : 0.14;
      pen.setLineDash(style === 1 ? [3, 4.5] : []); pen.stroke(path);
    }
  }
  pen.setLineDash([]);
  pen.strokeStyle = css("--s0"); pen.globalAlpha = 0.35; pen.lineWidth = 1.1; pen.lineJoin = "round"; pen.beginPath();
  now.path[0].forEach((x, k) => { const p = [x * now.scale + now.anchor[0], now.path[1][k] * now.scale + now.anchor[1]]; k ? pen.lineTo(...p) : pen.moveTo(...p); });
  pen.stroke(); pen.globalAlpha = 1;
  for (let a = 0; a < now.names.length; a++) trail(a, i);
  for (const [index, changes] of now.signals) {
    let state = 0;
    for (const [step, value] of changes) if (step <= i) state = value;
    if (!LAMP[state]) continue;
    const [x, y] = town.signals[index];
    pen.fillStyle = "#1f2937"; pen.beginPath(); pen.arc(x, y, 0.95, 0, 7); pen.fill();
    pen.fillStyle = LAMP[state]; pen.beginPath(); pen.arc(x, y, 0.65, 0, 7); pen.fill();
  }
  for (let a = now.names.length - 1; a >= 0; a--) if (present(a, i)) body(a, time);
  for (const [step] of now.hits) {
    if (time < step - 0.5) continue;
    const [x, y] = pose(0, time), age = Math.min((time - step) / 6, 1);
    pen.strokeStyle = css("--crash"); pen.lineWidth = 0.5; pen.beginPath(); pen.arc(x, y, 3.2 + 1.6 * Math.max(age, 0), 0, 7); pen.stroke();
    for (let k = 0; k < 10; k++) {
      const u = k * Math.PI / 5, r = 4.6 + 2 * Math.max(age, 0);
      pen.beginPath(); pen.moveTo(x + Math.cos(u) * r, y + Math.sin(u) * r);
      pen.lineTo(x + Math.cos(u) * (r + 1.4), y + Math.sin(u) * (r + 1.4)); pen.stroke();
    }
  }
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  scalebar(canvas.clientHeight);
  gauges(i);
}

function trail(a, i) {
  const from = Math.max(0, i - 30);
  if (now.kinds[a] === KIND.prop || i - from < 2) return;
  pen.strokeStyle = colour(a); pen.globalAlpha = 0.5; pen.lineWidth = a ? 0.3 : 0.45; pen.beginPath();
  for (let t = from; t <= i; t++) { const [x, y] = pose(a, t); t > from ? pen.lineTo(x, y) : pen.moveTo(x, y); }
  pen.stroke(); pen.globalAlpha = 1;
}

function scalebar(height) {
  const metres = [5, 10, 20, 50, 100].find((m) => m * view.scale > 60) || 200, w = metres * view.scale;
  pen.fillStyle = pen.strokeStyle = css("--ink"); pen.lineWidth = 2; pen.font = "12px system-ui, sans-serif";
  pen.beginPath(); pen.moveTo(14, height - 22); pen.lineTo(14, height - 16); pen.lineTo(14 + w, height - 16); pen.lineTo(14 + w, height - 22); pen.stroke();
  pen.fillText(`${metres} m`, 20, height - 22);
}

function gauges(i) {
  const [speed, throttle, brake, steer, complete, gap, off] = now.table.map((c) => c[i]);
  const share = (v) => `${Math.round(v / data.share * 100)} %`;
  const rows = [["speed", `${(speed * data.speed).toFixed(1)} m/s`], ["throttle", share(throttle)], ["brake", share(brake)],
    ["steer", share(steer)], ["nearest", gap * data.speed >= 299 ? "–" : `${(gap * data.speed).toFixed(1)} m`], ["route", `${(complete / 10).toFixed(0)} %`],
    ["on road", off ? "no" : "yes"]];
  $("gauges").innerHTML = rows.map(([k, v]) => `<div>${k}<b>${v}</b></div>`).join("");
  $("clock").textContent = `${(time * now.dt).toFixed(1)} s`;
  $("seek").value = Math.round(time);
}

function button() { $("play").textContent = playing ? "❚❚" : "▶"; $("follow").classList.toggle("on", follow); }
function tick(stamp) {
  if (playing && now) {
    time += Math.min(stamp - last, 100) / 1000 / now.dt * Number($("rate").value);
    if (time >= now.steps - 1) { time = now.steps - 1; playing = false; button(); }
    draw();
  }
  last = stamp;
  requestAnimationFrame(tick);
}
function toggle() {
  if (!now) return;
  if (!playing && time >= now.steps - 1) time = 0;
  playing = !playing; button();
}
function jump(step) { if (now) { playing = false; time = Math.min(Math.max(step, 0), now.steps - 1); button(); draw(); } }
function fit() {
  if (!now) return;
  const xs = Array.from(now.path[0], (v) => v * now.scale + now.anchor[0]), ys = Array.from(now.path[1], (v) => v * now.scale + now.anchor[1]);
  const low = [Math.min(...xs), Math.min(...ys)], high = [Math.max(...xs), Math.max(...ys)];
  view = { x: (low[0] + high[0]) / 2, y: (low[1] + high[1]) / 2,
    scale: Math.min(canvas.clientWidth / (high[0] - low[0] + 40), canvas.clientHeight / (high[1] - low[1] + 40)) };
  follow = false; button(); draw();
}

$("play").onclick = toggle;
$("follow").onclick = () => { follow = !follow; button(); draw(); };
$("fit").onclick = fit;
$("seek").oninput = (e) => jump(Number(e.target.value));
document.addEventListener("keydown", (e) => {
  if (/^(INPUT|SELECT)$/.test(e.target.tagName) && e.target.id !== "seek") return;
  const keys = { " ": toggle, ArrowRight: () => jump(Math.round(time) + 1), ArrowLeft: () => jump(Math.round(time) - 1), f: () => $("follow").click(), 0: fit };
  if (keys[e.key]) { e.preventDefault(); keys[e.key](); }
});
canvas.addEventListener("wheel", (e) => {
  e.preventDefault();
  view.scale = Math.min(Math.max(view.scale * Math.exp(-e.deltaY / 500), 0.6), 60);
  draw();
}, { passive: false });
let grip = null;
canvas.addEventListener("pointerdown", (e) => { grip = [e.clientX, e.clientY]; canvas.setPointerCapture(e.pointerId); });
canvas.addEventListener("pointermove", (e) => {
  if (!grip) return;
  follow = false; button();
  view.x -= (e.clientX - grip[0]) / view.scale; view.y += (e.clientY - grip[1]) / view.scale;
  grip = [e.clientX, e.clientY]; draw();
});
canvas.addEventListener("pointerup", () => { grip = null; });
window.addEventListener("resize", draw);

// In the frame of a comparison the page shows the replay alone, and both replays start together.
if (new URLSearchParams(location.search).has("replay")) document.body.classList.add("replay-only");
window.addEventListener("message", (event) => {
  if (event.data !== "ssad-play" || !now) return;
  time = 0; playing = true; button();
});

const marks = [...document.querySelectorAll(".matrix .mark")];
for (const system of new Set(marks.map((m) => m.dataset.system))) $("by-system").add(new Option(system, system));
function filter() {
  for (const m of marks) m.classList.toggle("off", ($("by-system").value && m.dataset.system !== $("by-system").value) || ($("by-outcome").value && m.dataset.outcome !== $("by-outcome").value));
}
$("by-system").onchange = $("by-outcome").onchange = filter;
marks.forEach((m) => { m.onclick = () => { m.blur(); location.hash = "cell-" + m.dataset.key; show(m.dataset.key); }; });
if (typeof DecompressionStream === "undefined") {
  $("name").textContent = "replays need a newer browser"; $("subtitle").textContent = "(Chrome 80, Firefox 113, Safari 16.4)";
} else {
  const asked = location.hash.replace("#cell-", ""), first = marks.find((m) => m.dataset.key === asked) || marks.find((m) => m.dataset.outcome === "collision") || marks[0];
  if (first) show(first.dataset.key);
  requestAnimationFrame(tick);
}
