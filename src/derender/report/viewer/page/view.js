"use strict";
// The page: asks the server for images at the controls' settings, the newest first, never two at a time.

const $ = (id) => document.getElementById(id);
const NAMES = {
  input: "the image as the model takes it",
  reconstruction: "rendered from the four factors",
  depth: "bright is near, dark is far",
  normals: "red to the right, green up, blue to the viewer",
  albedo: "colour without lighting",
  shading: "lighting on the surface",
};
const LIGHT = [
  ["ambient", "ambient", 0, 1.2, 0.01, ""],
  ["diffuse", "diffuse", 0, 1.2, 0.01, ""],
  ["pitch_deg", "pitch", -80, 80, 1, "°"],
  ["yaw_deg", "yaw", -80, 80, 1, "°"],
];
const CAMERA = ["pitch", "yaw", "roll", "right", "down", "away"];
const SAVES = {
  picture: ["picture", "png"], panel: ["panel", "png"], mesh: ["mesh", "glb"], archive: ["archive", "zip"], settings: ["settings", "json"],
};

let about;
let first = null; // {picture, source, name, image, light, camera}
let second = null;
const now = { light: null, camera: null, swaps: new Set(), size: null };
const sliders = { light: [], camera: [] };
let surface;

function say(text, wrong = false) {
  $("status").textContent = text;
  $("status").classList.toggle("wrong", wrong);
}

async function ask(path, body) {
  const binary = body instanceof Blob;
  const headers = { "x-derender-page": "1", "content-type": binary ? "application/octet-stream" : "application/json" };
  let answer;
  try {
    answer = await fetch(path, { method: "POST", headers, body: binary ? body : JSON.stringify(body ?? {}) });
  } catch {
    throw new Error("The program does not answer. Is it still running?");
  }
  if (answer.ok) return answer;
  let reason = `the program answered ${answer.status}`;
  try { reason = (await answer.json()).error || reason; } catch { /* no words came with it */ }
  const problem = new Error(reason[0].toUpperCase() + reason.slice(1) + ".");
  problem.status = answer.status;
  throw problem;
}

function question(more = {}) {
  const swaps = {};
  for (const factor of ["geometry", "albedo"]) if (second && now.swaps.has(factor)) swaps[factor] = second.picture;
  return { picture: first.picture, swaps, light: now.light, camera: now.camera, size: now.size, ...more };
}

// Ask about the images on the page; those that are no longer stored are opened again first.
async function askAbout(path, more = {}) {
  try {
    return await ask(path, question(more));
  } catch (problem) {
    if (problem.status !== 410) throw problem;
    for (const one of [first, second]) if (one) one.picture = (await (await request(one.source)).json()).picture;
    return ask(path, question(more));
  }
}

const request = (source) => (source instanceof Blob ? ask("api/pictures", source) : ask(source));

// Runs `work` again after it ends if it was called meanwhile, but never twice at once.
function newest(work) {
  let running = null;
  let again = false;
  const run = async () => {
    do { again = false; await work(); } while (again);
  };
  return () => {
    if (running) { again = true; return running; }
    running = run().catch((problem) => say(problem.message, true)).finally(() => { running = null; });
    return running;
  };
}

function paint(canvas, bitmap, left, side) {
  if (canvas.width !== side) { canvas.width = side; canvas.height = side; }
  const context = canvas.getContext("2d");
  context.clearRect(0, 0, side, side);
  context.drawImage(bitmap, left, 0, side, side, 0, 0, side, side);
}

const times = [];
const refreshView = newest(async () => {
  const began = performance.now();
  const bitmap = await createImageBitmap(await (await askAbout("api/view")).blob());
  const side = bitmap.height;
  paint($("view"), bitmap, 0, side);
  paint($("map-shading"), bitmap, side, side);
  bitmap.close();
  times.push(performance.now() - began);
  if (times.length > 20) times.shift();
  const median = [...times].sort((a, b) => a - b)[times.length >> 1];
  $("speed").textContent = `${Math.max(1, Math.round(median))} ms`;
  $("view").dataset.drawn = String(Number($("view").dataset.drawn || 0) + 1);
});

const refreshMaps = newest(async () => {
  const maps = await (await askAbout("api/factors")).json();
  for (const name of Object.keys(NAMES)) if (name !== "shading") $(`map-${name}`).src = maps[name];
});

const refreshSurface = newest(async () => {
  try {
    if (surface.gl) await surface.show(await (await askAbout("api/mesh")).arrayBuffer());
    else surface.draw();
  } catch (problem) {
    if (problem.status !== 422) throw problem;
    say(`No surface: ${problem.message}`, true);
  }
});

const drawOrbit = newest(async () => {
  if (!first) return;
  const camera = { rotation_deg: [surface.pitch, surface.yaw * -1, 0].map((angle) => Math.max(-89, Math.min(89, (angle * 180) / Math.PI))), translation: [0, 0, 0] };
  const bitmap = await createImageBitmap(await (await askAbout("api/view", { camera })).blob());
  paint(surface.canvas, bitmap, 0, bitmap.height);
});

const refreshNeighbours = newest(async () => {
  const pressed = $("near-factors").querySelector("[aria-pressed=true]");
  if (!about.table || !pressed) return;
  const found = await (await askAbout("api/neighbours", { factor: pressed.dataset.factor, k: 12 })).json();
  $("near-rows").replaceChildren(...found.rows.map((row) => {
    const words = [row.file, ...Object.entries(row.labels).map(([name, value]) => `${name}: ${value}`)];
    const button = pictureButton(row.image, `Open ${row.file}, distance ${row.distance.toFixed(3)}`, () => openFirst(`api/rows/${row.row}`, row.file, row.image));
    button.title = words.join("\n");
    for (const text of [row.distance.toFixed(3), row.file.split("/").pop()]) {
      const line = document.createElement("span");
      line.textContent = text;
      button.append(line);
    }
    return button;
  }));
});

function pictureButton(image, label, act) {
  const button = document.createElement("button");
  button.type = "button";
  button.setAttribute("aria-label", label);
  const shown = document.createElement(image ? "img" : "i");
  if (image) { shown.src = image; shown.alt = ""; } else shown.textContent = "not here";
  button.append(shown);
  button.addEventListener("click", () => act(button));
  return button;
}

function refreshAll() {
  surface.light = now.light;
  return Promise.all([refreshView(), refreshMaps(), refreshSurface(), refreshNeighbours()]);
}

function moved() {
  surface.light = now.light;
  surface.draw();
  refreshView();
}

function showSliders() {
  for (const kind of ["light", "camera"]) for (const slider of sliders[kind]) slider.show();
}

function slider(kind, label, range, get, set) {
  const [low, high, step, unit] = range;
  const row = document.createElement("div");
  const [name, input, value] = ["label", "input", "output"].map((tag) => document.createElement(tag));
  row.className = "slider";
  input.type = "range";
  input.id = `${kind}-${label}`;
  name.htmlFor = value.htmlFor = input.id;
  name.textContent = label;
  Object.assign(input, { min: low, max: high, step });
  const tell = () => {
    value.textContent = `${get().toFixed(step < 0.01 ? 3 : step < 1 ? 2 : 0)}${unit}`;
    input.setAttribute("aria-valuetext", value.textContent);
  };
  input.addEventListener("input", () => { set(Number(input.value)); tell(); moved(); });
  row.append(name, input, value);
  $(`${kind}-sliders`).append(row);
  sliders[kind].push({ show: () => { input.value = get(); tell(); } });
}

function buildControls() {
  for (const [key, label, low, high, step, unit] of LIGHT) {
    slider("light", label, [low, high, step, unit], () => now.light[key], (value) => { now.light[key] = value; });
  }
  const turn = Math.ceil(about.rotation_deg);
  CAMERA.forEach((label, place) => {
    const turning = place < 3;
    const reach = turning ? turn : about.translation[place - 3];
    const list = () => (turning ? now.camera.rotation_deg : now.camera.translation);
    slider("camera", label, [-reach, reach, turning ? 1 : 0.001, turning ? "°" : ""], () => list()[place % 3], (value) => { list()[place % 3] = value; });
  });
  for (const size of about.sizes) $("size").add(new Option(`${size} px`, size));
  now.size = about.sizes.filter((size) => size <= 256).at(-1);
  $("size").value = now.size;
}

function buildMaps() {
  for (const [name, meaning] of Object.entries(NAMES)) {
    const cell = document.createElement("div");
    const shown = document.createElement(name === "shading" ? "canvas" : "img");
    shown.id = `map-${name}`;
    if (name === "shading") { shown.setAttribute("role", "img"); shown.setAttribute("aria-label", `${name}: ${meaning}`); } else shown.alt = `${name}: ${meaning}`;
    const [title, words] = ["b", "span"].map((tag) => document.createElement(tag));
    title.textContent = name;
    words.textContent = meaning;
    cell.append(shown, title, words);
    $("maps").append(cell);
  }
}

function asFound(kind) {
  const from = second && now.swaps.has(kind) ? second : first;
  now[kind] = structuredClone(from[kind]);
}

async function opened(source, name, image) {
  if (source instanceof Blob && source.size > about.body_limit_bytes) {
    throw new Error(`This file is larger than ${Math.round(about.body_limit_bytes / 1e6)} MB: make the image smaller first.`);
  }
  say(`Decomposing ${name}.`);
  const found = await (await request(source)).json();
  return { ...found, source, name, image };
}

async function openFirst(source, name, image = null, button = null) {
  try {
    first = await opened(source, name, image);
    for (const kind of ["light", "camera"]) asFound(kind);
    showSliders();
    press("examples", button);
    const before = first.l1_feed_forward === null ? "" : `; ${first.l1_feed_forward.toFixed(3)} before optimisation`;
    const error = first.l1 === null ? "the model renders nothing into it" : `mean difference ${first.l1.toFixed(3)} where the surface is seen${before}`;
    const beaten = first.percentile >= 100 ? "any" : `${Math.floor(first.percentile)} %`;
    const rank = first.percentile === null ? "" : `, more than for ${beaten} of the images the model was validated on`;
    const share = `${Math.round(100 * first.side)} % of its side`;
    const part = {
      face: ` Shown is the face that was found, ${share}.`,
      auto: first.side === 1 ? "" : ` Shown is the part of it that the model reconstructs best, ${share}.`,
      "no face": " No face was found: shown is its middle.",
    }[first.framed] ?? "";
    say(`${name}: ${error}${rank}.${part}`);
    $("unlike").hidden = !first.out_of_distribution;
    $("unlike").textContent = "This image is reconstructed worse than nearly all the model was validated on: it may be out-of-distribution. Read its factors with care.";
    $("work").hidden = false;
    times.length = 0;
    await refreshAll();
    document.body.dataset.ready = first.picture;
  } catch (problem) { say(problem.message, true); }
}

async function openSecond(source, name, image = null, button = null) {
  try {
    second = await opened(source, name, image ?? URL.createObjectURL(source));
    press("examples-second", button);
    $("second").src = second.image;
    $("second").alt = `second image: ${name}`;
    $("second").hidden = $("swaps").hidden = false;
    say(`${name} is the second image. Choose a factor to take from it.`);
    for (const kind of ["light", "camera"]) if (now.swaps.has(kind)) asFound(kind);
    showSliders();
    if (now.swaps.size) await refreshAll();
  } catch (problem) { say(problem.message, true); }
}

function press(strip, button) {
  for (const other of $(strip).querySelectorAll("[aria-pressed]")) other.setAttribute("aria-pressed", String(other === button));
}

function acceptFiles(zone, input, open) {
  const take = (files) => { if (files.length) open(files[0], files[0].name); };
  input.addEventListener("change", () => { take([...input.files]); input.value = ""; });
  for (const kind of ["dragover", "dragenter"]) zone.addEventListener(kind, (event) => { event.preventDefault(); zone.classList.add("over"); });
  for (const kind of ["dragleave", "drop"]) zone.addEventListener(kind, () => zone.classList.remove("over"));
  zone.addEventListener("drop", (event) => { event.preventDefault(); event.stopPropagation(); take([...event.dataTransfer.files]); });
}

function dragOnPicture() {
  const canvas = $("view");
  let last = null;
  canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); last = [event.clientX, event.clientY]; });
  canvas.addEventListener("pointermove", (event) => {
    if (!last || !first) return;
    const [x, y] = [event.clientX - last[0], event.clientY - last[1]].map((pixels) => (pixels * 120) / canvas.clientWidth);
    last = [event.clientX, event.clientY];
    const held = (value, limit) => Math.max(-limit, Math.min(limit, value));
    if ($("drag").value === "light") {
      now.light.yaw_deg = held(now.light.yaw_deg - x, 80);
      now.light.pitch_deg = held(now.light.pitch_deg - y, 80);
    } else {
      const turn = now.camera.rotation_deg;
      turn[1] = held(turn[1] - x, about.rotation_deg);
      turn[0] = held(turn[0] + y, about.rotation_deg);
    }
    showSliders();
    moved();
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => { last = null; });
}

async function save(kind) {
  try {
    const [path, suffix] = SAVES[kind];
    const blob = await (await askAbout(`api/${path}`)).blob();
    const link = document.createElement("a");
    link.href = URL.createObjectURL(blob);
    link.download = `${first.name.replace(/\.[^.]*$/, "").replace(/[^\w-]+/g, "_").slice(0, 60) || "picture"}-${kind}.${suffix}`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
    say(`Saved ${link.download}.`);
  } catch (problem) { say(problem.message, true); }
}

async function loadSettings(file) {
  try {
    const found = JSON.parse(await file.text());
    const light = Object.fromEntries(LIGHT.map(([key]) => [key, Number(found.light[key])]));
    const camera = { rotation_deg: found.camera.rotation_deg.map(Number), translation: found.camera.translation.map(Number) };
    const numbers = [...Object.values(light), ...camera.rotation_deg, ...camera.translation];
    if (numbers.length !== 10 || !numbers.every(Number.isFinite)) throw new Error();
    Object.assign(now, { light, camera });
    showSliders();
    moved();
    say(`Light and camera are those of ${file.name}.`);
  } catch { say(`${file.name} holds no settings of this page.`, true); }
}

function connect() {
  acceptFiles($("drop"), $("file"), openFirst);
  acceptFiles($("drop-second"), $("file-second"), openSecond);
  for (const kind of ["dragover", "drop"]) document.addEventListener(kind, (event) => event.preventDefault());
  document.addEventListener("drop", (event) => { if (event.dataTransfer.files.length) openFirst(event.dataTransfer.files[0], event.dataTransfer.files[0].name); });
  document.addEventListener("paste", (event) => { const file = [...event.clipboardData.files][0]; if (file) openFirst(file, file.name || "pasted picture"); });
  for (const [strip, open] of [["examples", openFirst], ["examples-second", openSecond]]) {
    $(strip).append(...about.examples.map((example, number) => {
      const button = pictureButton(example.image, example.name, (own) => open(`api/examples/${number}`, example.name, example.image, own));
      button.setAttribute("aria-pressed", "false");
      return button;
    }));
  }
  $("light-reset").addEventListener("click", () => { asFound("light"); showSliders(); moved(); });
  $("camera-reset").addEventListener("click", () => { asFound("camera"); showSliders(); moved(); });
  $("camera-front").addEventListener("click", () => { now.camera = { rotation_deg: [0, 0, 0], translation: [0, 0, 0] }; showSliders(); moved(); });
  $("size").addEventListener("change", () => { now.size = Number($("size").value); times.length = 0; refreshAll(); });
  $("paint").addEventListener("change", () => { surface.paint = $("paint").value; surface.draw(); });
  $("front").addEventListener("click", () => { surface.front(); surface.draw(); });
  $("controls").addEventListener("submit", (event) => event.preventDefault());
  $("swaps").addEventListener("change", (event) => {
    const { name, checked } = event.target;
    if (checked) now.swaps.add(name); else now.swaps.delete(name);
    if (name === "light" || name === "camera") { asFound(name); showSliders(); moved(); } else refreshAll();
  });
  for (const button of document.querySelectorAll("[data-save]")) button.addEventListener("click", () => save(button.dataset.save));
  $("load-settings").addEventListener("change", (event) => { if (event.target.files.length) loadSettings(event.target.files[0]); event.target.value = ""; });
  dragOnPicture();
}

function buildNeighbours() {
  if (!about.table || !about.table.factors.length) return;
  $("near").hidden = false;
  $("near-note").textContent = `Among ${about.table.rows.toLocaleString("en")} images, by cosine distance.${about.table.note ? ` No images: ${about.table.note}.` : " Choose one to decompose it."}`;
  about.table.factors.forEach((factor, place) => {
    const button = document.createElement("button");
    button.type = "button";
    button.dataset.factor = button.textContent = factor;
    button.setAttribute("aria-pressed", String(place === 0));
    button.addEventListener("click", () => {
      for (const other of $("near-factors").children) other.setAttribute("aria-pressed", String(other === button));
      refreshNeighbours();
    });
    $("near-factors").append(button);
  });
}

async function begin() {
  about = await (await fetch("api/about")).json();
  $("model").textContent = about.model;
  $("version").textContent = about.derender;
  $("kept").textContent = about.kept;
  if (!about.table && !about.examples.length) $("examples").hidden = $("examples-second").hidden = true;
  buildControls();
  buildMaps();
  buildNeighbours();
  surface = new Surface($("surface"), drawOrbit);
  surface.fovDeg = about.fov_deg;
  connect();
  const start = about.examples[0];
  if (start) await openFirst("api/examples/0", start.name, start.image, $("examples").firstElementChild);
  else say("Drop an image to begin.");
}

begin().catch((problem) => say(problem.message, true));
