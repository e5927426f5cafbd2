"use strict";
// The page: asks the server for images at the controls' settings, the newest first, never two at a time.

const $ = (id) => document.getElementById(id);
const NAMES = {
  input: "the crop that the model receives",
  reconstruction: "rendered from all factors",
  depth: "bright is near, dark is far",
  normals: "red to the right, green up, blue to the viewer",
  albedo: "colour without lighting",
  shading: "lighting on the surface",
};
const LIGHT = [
  ["ambient", "ambient", 0, 1.2, 0.01, ""],
  ["diffuse", "direct", 0, 1.2, 0.01, ""],
  ["pitch_deg", "height", -80, 80, 1, "°"],
  ["yaw_deg", "side", -80, 80, 1, "°"],
];
const CAMERA = [["pitch", "nod"], ["yaw", "turn"], ["roll", "tilt"], ["right", "right"], ["down", "down"], ["away", "away"]];
const DRAFT = 256, SETTLED = 512, TEXTURE = 1024;
const SAVES = {
  picture: ["picture", "png"], panel: ["panel", "png"], mesh: ["mesh", "glb"], archive: ["archive", "zip"], settings: ["settings", "json"],
  gif: ["film", "gif"], mp4: ["film", "mp4"],
};

let about;
let first = null; // {picture, source, name, image, light, camera, crop, faces, framed, fit, width, height}
let second = null;
const now = { light: null, camera: null, numbers: {}, swaps: new Set(), size: SETTLED, detail: "photo", whole: false };
let waiting = 0;
const sliders = { light: [], camera: [], numbers: [] };
let surface;

function say(text, wrong = false) {
  $("status").textContent = text;
  $("status").classList.toggle("wrong", wrong);
}

async function ask(path, body) {
  const binary = body instanceof Blob;
  const headers = { "x-derender-page": "1", "content-type": binary ? "application/octet-stream" : "application/json" };
  let answer;
  if (path !== "api/view") { waiting += 1; document.body.toggleAttribute("data-busy", true); }
  try {
    answer = await fetch(path, { method: "POST", headers, body: binary ? body : JSON.stringify(body ?? {}) });
  } catch {
    throw new Error("The program does not answer. Is it still running?");
  } finally {
    if (path !== "api/view") { waiting -= 1; document.body.toggleAttribute("data-busy", waiting > 0); }
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
  for (const factor of about.light ? ["geometry", "albedo"] : ["geometry", "albedo", "light"]) if (second && now.swaps.has(factor)) swaps[factor] = second.picture;
  const light = about.light ? now.light : null;
  return { picture: first.picture, swaps, light, camera: now.camera, numbers: now.numbers, size: now.size, detail: now.detail, whole: now.whole, ...more };
}

// Ask about the images on the page; those that are no longer stored are opened again first.
async function askAbout(path, more = {}) {
  try {
    return await ask(path, question(more));
  } catch (problem) {
    if (problem.status !== 410) throw problem;
    for (const one of [first, second]) {
      if (!one) continue;
      one.picture = (await (await request(one.source)).json()).picture;
      if (one.asked) one.picture = (await cropped(one, one.crop, one.fit)).picture;
    }
    return ask(path, question(more));
  }
}

const cropped = async (one, crop, fit) => (await ask("api/crop", { picture: one.picture, crop, fit })).json();
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

function paint(canvas, bitmap) {
  if (canvas.width !== bitmap.width || canvas.height !== bitmap.height) { canvas.width = bitmap.width; canvas.height = bitmap.height; }
  const context = canvas.getContext("2d");
  context.clearRect(0, 0, canvas.width, canvas.height);
  context.drawImage(bitmap, 0, 0);
  bitmap.close();
}

// As large as fits into the mat around it.
function fitSheet(sheet, width, height) {
  sheet.style.aspectRatio = `${width} / ${height}`;
  const mat = sheet.parentElement.getBoundingClientRect();
  const wide = width / height > mat.width / mat.height;
  sheet.style.width = wide ? "100%" : "auto";
  sheet.style.height = wide ? "auto" : "100%";
  sheet.dataset.ratio = `${width} ${height}`;
}

const refreshView = newest(async () => {
  const [began, size] = [performance.now(), now.size];
  const bitmap = await createImageBitmap(await (await askAbout("api/view")).blob());
  fitSheet($("view-sheet"), bitmap.width, bitmap.height);
  paint($("view"), bitmap);
  Object.assign($("view").dataset, { ms: Math.round(performance.now() - began), still: size === SETTLED && now.size === size });
});

function showBlob(image, blob) {
  if (image.src.startsWith("blob:")) URL.revokeObjectURL(image.src);
  image.src = URL.createObjectURL(blob);
}

const refreshBefore = newest(async () => showBlob($("before"), await (await askAbout("api/before")).blob()));

const refreshMaps = newest(async () => {
  const maps = await (await askAbout("api/factors", { size: DRAFT })).json();
  for (const name of Object.keys(maps)) $(`map-${name}`).src = maps[name];
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
  const bitmap = await createImageBitmap(await (await askAbout("api/view", { camera, detail: "model", size: DRAFT })).blob());
  paint(surface.canvas, bitmap);
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

async function refreshAll() {
  surface.light = now.light;
  await Promise.all([refreshView(), refreshBefore()]);
  await Promise.all([refreshMaps(), refreshSurface(), refreshNeighbours()]);
}

let settling;
function moved() {
  surface.light = now.light;
  surface.draw();
  showSun();
  now.size = DRAFT;
  $("view").dataset.still = false;
  refreshView();
  clearTimeout(settling);
  settling = setTimeout(() => { now.size = SETTLED; refreshView(); refreshMaps(); }, 200);
}

function showSun() {
  $("sun").hidden = dragged() !== "light";
  $("sun").style.left = `${50 - now.light.yaw_deg * 0.55}%`;
  $("sun").style.top = `${50 - now.light.pitch_deg * 0.55}%`;
}

const dragged = () => document.querySelector("[name=drag]:checked").value;

function showSliders() {
  for (const slider of Object.values(sliders).flat()) slider.show();
}

function slider(kind, id, label, range, get, set, shown = (value) => value) {
  const [low, high, step, unit] = range;
  const row = document.createElement("div");
  const [name, input, value] = ["label", "input", "output"].map((tag) => document.createElement(tag));
  row.className = "slider";
  input.type = "range";
  input.id = `${kind}-${id}`;
  name.htmlFor = value.htmlFor = input.id;
  name.textContent = label;
  Object.assign(input, { min: low, max: high, step });
  const tell = () => {
    value.textContent = `${shown(get()).toFixed(step < 0.01 ? 3 : step < 1 ? 2 : 0)}${unit}`;
    input.setAttribute("aria-valuetext", value.textContent);
  };
  input.addEventListener("input", () => { set(Number(input.value)); tell(); moved(); });
  row.append(name, input, value);
  $(kind === "camera" && range[3] === "" ? "shift-sliders" : `${kind}-sliders`).append(row);
  sliders[kind].push({ show: () => { input.value = get(); tell(); } });
}

function buildControls() {
  for (const [key, label, low, high, step, unit] of LIGHT) {
    slider("light", key.replace("_deg", ""), label, [low, high, step, unit], () => now.light[key], (value) => { now.light[key] = value; });
  }
  const turn = Math.ceil(about.rotation_deg);
  CAMERA.forEach(([id, label], place) => {
    const turning = place < 3;
    const reach = turning ? turn : about.translation[place - 3];
    const list = () => (turning ? now.camera.rotation_deg : now.camera.translation);
    slider("camera", id, label, [-reach, reach, turning ? 1 : 0.001, turning ? "°" : ""], () => list()[place % 3], (value) => { list()[place % 3] = value; });
  });
  for (const [factor, numbers] of Object.entries(about.numbers)) {
    numbers.forEach(({ name, low, high, log }, place) => {
      const [to, from] = log ? [Math.log, Math.exp] : [(value) => value, (value) => value]; // even steps on the slider
      const range = [to(low), to(high), (to(high) - to(low)) / 100, ""];
      const set = (value) => { now.numbers[factor][place] = Math.min(high, Math.max(low, from(value))); };
      slider("numbers", `${factor}-${name}`, `${factor} ${name}`, range, () => to(now.numbers[factor][place]), set, from);
    });
    const [label, box] = ["label", "input"].map((tag) => document.createElement(tag));
    Object.assign(box, { type: "checkbox", name: factor });
    label.append(box, ` ${factor}`);
    $("swaps").append(label);
  }
  $("numbers-fields").hidden = !sliders.numbers.length;
  if (!about.light) {
    $("light-fields").hidden = true;
    document.querySelector("[name=drag][value=camera]").checked = true;
    document.querySelector("[name=drag][value=light]").disabled = true;
  }
  $("fit-line").hidden = !about.can_fit;
  $("fit").checked = about.fits;
  $("framing").options[0].hidden = !about.faces;
}

function buildMaps() {
  for (const [name, meaning] of [...Object.entries(NAMES), ...about.maps.map((title) => [title, "an effect of the renderer"])]) {
    const cell = document.createElement("div");
    const shown = document.createElement("img");
    shown.id = `map-${name}`;
    shown.alt = `${name}: ${meaning}`;
    const [title, words] = ["b", "span"].map((tag) => document.createElement(tag));
    title.textContent = name;
    words.textContent = meaning;
    cell.append(shown, title, words);
    $("maps").append(cell);
  }
}

function asFound(kind) {
  const from = second && now.swaps.has(kind) ? second : first;
  if (kind in about.numbers) now.numbers[kind] = [...from.numbers[kind]]; else now[kind] = structuredClone(from[kind]);
}

const movable = () => ["light", "camera", ...Object.keys(about.numbers)];

async function opened(source, name, image) {
  if (source instanceof Blob && source.size > about.body_limit_bytes) {
    throw new Error(`This file is larger than ${Math.round(about.body_limit_bytes / 1e6)} MB: make the image smaller first.`);
  }
  say(`Reading ${name}.`);
  const found = await (await request(source)).json();
  return { ...found, source, name, image, fit: about.fits };
}

async function openFirst(source, name, image = null, button = null) {
  try {
    first = await opened(source, name, image);
    now.swaps.clear();
    for (const box of document.querySelectorAll("#swaps input")) box.checked = false;
    $("fit").checked = first.fit;
    $("compare").value = 0;
    compare();
    press("examples", button);
    $("work").hidden = false;
    showBlob($("photo"), await (await ask("api/preview", { picture: first.picture })).blob());
    fitSheet($("photo-sheet"), first.width, first.height);
    showFaces();
    await begun();
  } catch (problem) { say(problem.message, true); }
}

// What the model found in a photograph or in another part of it.
async function begun() {
  for (const kind of movable()) asFound(kind);
  showSliders();
  showSun();
  showCrop();
  now.size = SETTLED;
  tell();
  await refreshAll();
  document.body.dataset.ready = first.picture;
}

function tell() {
  const before = first.l1_feed_forward === null ? "" : ` (${first.l1_feed_forward.toFixed(3)} before the fit)`;
  const beaten = first.percentile >= 100 ? "any" : `${Math.floor(first.percentile)} %`;
  const rank = first.percentile === null ? "" : `, more than for ${beaten} of the images the model was validated on`;
  $("error").textContent = first.l1 === null ? "The model draws nothing into this crop." : `Mean difference between crop and reconstruction: ${first.l1.toFixed(3)}${before}${rank}.`;
  const count = first.faces.length;
  const part = count > 1 ? `${count} faces found; press one to choose it` : count ? "one face found" : first.framed === "no face" ? "no face found; move the square to one" : "opened";
  say(`${first.name}: ${part}.`);
  $("framing").value = first.framed === "no face" ? "none" : first.framed;
  $("unlike").hidden = !first.out_of_distribution;
  $("unlike").textContent = "The model reconstructs this crop worse than nearly all validation images: it may show another kind of object. Read its factors with care.";
}

const recrop = newest(async () => {
  if (!first.asked) return; // another photograph came meanwhile
  const { crop, fit } = first.asked;
  say(fit ? "Fitting to the photograph." : "Reading the crop.");
  try {
    Object.assign(first, await cropped(first, crop, fit), { fit });
  } catch (problem) {
    showCrop();
    $("framing").value = first.framed === "no face" ? "none" : first.framed;
    $("fit").checked = first.fit;
    throw problem;
  }
  await begun();
});

function cropTo(crop, fit = $("fit").checked) {
  first.asked = { crop, fit };
  recrop();
}

function placeSquare(element, square) {
  element.style.left = `${(100 * square.x) / first.width}%`;
  element.style.top = `${(100 * square.y) / first.height}%`;
  element.style.width = `${(100 * square.side) / first.width}%`;
  element.style.setProperty("--roll", `${square.roll_deg}deg`);
}

function showCrop() {
  placeSquare($("crop"), first.crop);
  const same = (face) => Math.hypot(face.x - first.crop.x, face.y - first.crop.y) < first.crop.side / 20;
  [...$("faces").children].forEach((button, number) => button.setAttribute("aria-pressed", String(same(first.faces[number]))));
}

function showFaces() {
  $("faces").replaceChildren(...first.faces.map((face, number) => {
    const button = document.createElement("button");
    button.type = "button";
    button.setAttribute("aria-label", `Face ${number + 1} of ${first.faces.length}`);
    placeSquare(button, face);
    button.addEventListener("click", () => cropTo({ ...face }));
    return button;
  }));
}

async function openSecond(source, name, image = null, button = null) {
  try {
    second = await opened(source, name, image ?? URL.createObjectURL(source));
    press("examples-second", button);
    $("second").src = second.image;
    $("second").alt = `second photograph: ${name}`;
    $("second").hidden = $("swaps").hidden = false;
    say(`${name} is the second photograph. Choose what to take from it.`);
    for (const kind of movable()) if (now.swaps.has(kind)) asFound(kind);
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

const held = (value, limit) => Math.max(-limit, Math.min(limit, value));

// By degrees to the right and down on the result.
function nudge(x, y) {
  if (dragged() === "light") {
    now.light.yaw_deg = held(now.light.yaw_deg - x, 80);
    now.light.pitch_deg = held(now.light.pitch_deg - y, 80);
  } else {
    const turn = now.camera.rotation_deg;
    turn[1] = held(turn[1] - x, about.rotation_deg);
    turn[0] = held(turn[0] + y, about.rotation_deg);
  }
  showSliders();
  moved();
}

const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

function backToOriginal() {
  for (const kind of movable()) asFound(kind);
  showSliders();
  moved();
}

function dragOnPicture() {
  const canvas = $("view");
  let last = null;
  canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); last = [event.clientX, event.clientY]; });
  canvas.addEventListener("pointermove", (event) => {
    if (!last || !first) return;
    const [x, y] = [event.clientX - last[0], event.clientY - last[1]].map((pixels) => (pixels * 150) / canvas.clientWidth);
    last = [event.clientX, event.clientY];
    nudge(x, y);
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => { last = null; });
  canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || !first) return;
    if (event.key === "0") backToOriginal(); else if (ARROWS[event.key]) nudge(...ARROWS[event.key].map((step) => 4 * step)); else return;
    event.preventDefault();
  });
}

function dragCrop() {
  const crop = $("crop");
  let start = null;
  const within = (square) => ({
    ...square,
    side: Math.max(16, Math.min(square.side, 2 * Math.max(first.width, first.height))),
    x: Math.max(0, Math.min(first.width, square.x)),
    y: Math.max(0, Math.min(first.height, square.y)),
  });
  const shown = (square) => { placeSquare(crop, square); return square; };
  crop.addEventListener("pointerdown", (event) => {
    event.preventDefault();
    crop.focus({ preventScroll: true });
    crop.setPointerCapture(event.pointerId);
    const box = $("photo-sheet").getBoundingClientRect();
    const scale = first.width / box.width;
    const at = (e) => [(e.clientX - box.left) * scale, (e.clientY - box.top) * scale];
    start = { at, from: at(event), square: first.crop, corner: event.target !== crop, moved: null };
  });
  crop.addEventListener("pointermove", (event) => {
    if (!start) return;
    const [x, y] = start.at(event);
    const { square, from } = start;
    const away = (point) => Math.hypot(point[0] - square.x, point[1] - square.y);
    const next = start.corner ? { ...square, side: (square.side * away([x, y])) / Math.max(1, away(from)) } : { ...square, x: square.x + x - from[0], y: square.y + y - from[1] };
    start.moved = shown(within(next));
  });
  crop.addEventListener("pointerup", () => { if (start && start.moved) cropTo(start.moved); start = null; });
  crop.addEventListener("pointercancel", () => { start = null; showCrop(); });
  crop.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || !first) return;
    const [x, y] = ARROWS[event.key] || [0, 0];
    const grow = { "+": 1.06, "=": 1.06, "-": 1 / 1.06 }[event.key] || 1;
    if (!x && !y && grow === 1) return;
    event.preventDefault();
    const { crop: square } = first;
    first.crop = shown(within({ ...square, x: square.x + (x * square.side) / 30, y: square.y + (y * square.side) / 30, side: square.side * grow }));
    cropTo(first.crop);
  });
}

function compare() {
  const share = Number($("compare").value);
  $("before").style.clipPath = `inset(0 ${100 - share}% 0 0)`;
  $("divider").hidden = share === 0 || share === 100;
  $("divider").style.left = `${share}%`;
}

async function save(kind) {
  try {
    const [path, suffix] = SAVES[kind];
    const more = path === "film" ? { kind: suffix, move: dragged() } : { size: path === "mesh" ? TEXTURE : SETTLED };
    if (path === "film") say(`Making a film of the ${dragged() === "light" ? "light" : "view"}.`);
    const blob = await (await askAbout(`api/${path}`, more)).blob();
    const link = document.createElement("a");
    link.href = URL.createObjectURL(blob);
    link.download = `${first.name.replace(/\.[^.]*$/, "").replace(/[^\w-]+/g, "_").slice(0, 60) || "picture"}-${path}.${suffix}`;
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
    for (const factor of Object.keys(about.numbers)) if (found.numbers && found.numbers[factor]) now.numbers[factor] = found.numbers[factor].map(Number);
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
  document.addEventListener("paste", (event) => { const file = [...event.clipboardData.files][0]; if (file) openFirst(file, file.name || "pasted image"); });
  for (const [strip, open] of [["examples", openFirst], ["examples-second", openSecond]]) {
    $(strip).append(...about.examples.map((example, number) => {
      const button = pictureButton(example.image, example.name, (own) => open(`api/examples/${number}`, example.name, example.image, own));
      button.setAttribute("aria-pressed", "false");
      return button;
    }));
  }
  $("reset").addEventListener("click", backToOriginal);
  $("camera-front").addEventListener("click", () => { now.camera = { rotation_deg: [0, 0, 0], translation: [0, 0, 0] }; showSliders(); moved(); });
  $("drag").addEventListener("change", showSun);
  $("compare").addEventListener("input", compare);
  $("framing").addEventListener("change", () => cropTo($("framing").value));
  $("fit").addEventListener("change", () => cropTo(first.framed === "own" ? first.crop : null));
  $("texture").addEventListener("change", () => { now.detail = $("texture").value; refreshAll(); });
  $("whole").addEventListener("change", () => { now.whole = $("whole").checked; refreshView(); refreshBefore(); });
  addEventListener("resize", () => { for (const sheet of [$("photo-sheet"), $("view-sheet")]) if (sheet.dataset.ratio) fitSheet(sheet, ...sheet.dataset.ratio.split(" ").map(Number)); });
  $("paint").addEventListener("change", () => { surface.paint = $("paint").value; surface.draw(); });
  $("front").addEventListener("click", () => { surface.front(); surface.draw(); });
  $("controls").addEventListener("submit", (event) => event.preventDefault());
  $("swaps").addEventListener("change", (event) => {
    const { name, checked } = event.target;
    if (checked) now.swaps.add(name); else now.swaps.delete(name);
    if (movable().includes(name) && (about.light || name !== "light")) { asFound(name); showSliders(); moved(); } else refreshAll();
  });
  for (const button of document.querySelectorAll("[data-save]")) button.addEventListener("click", () => save(button.dataset.save));
  $("load-settings").addEventListener("change", (event) => { if (event.target.files.length) loadSettings(event.target.files[0]); event.target.value = ""; });
  dragOnPicture();
  dragCrop();
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
  else say("Choose, drop or paste a photograph to begin.");
}

begin().catch((problem) => say(problem.message, true));
