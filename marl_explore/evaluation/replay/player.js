"use strict";
// The controls: they change `state`, and show() brings the page in line with it.

const SPEEDS = [1, 2, 4, 8, 16, 32]; // steps per second
const LAYERS = ["Trails", "Links", "Frontiers", "Arrows", "Sight"];
const ACTIONS = ["\u2191 N", "\u2197 NE", "\u2192 E", "\u2198 SE", "\u2193 S", "\u2199 SW", "\u2190 W", "\u2196 NW", "stay", "communicate"];
const THEME = ["unknown", "free", "obstacle", "frontier", "grid", "link", "outline", "walker"];
const COMMUNICATE = 9;

const element = (id) => document.getElementById(id);
const { episodes, colors } = JSON.parse(element("data").textContent);
for (const episode of episodes) episode.walls = new Set(episode.obstacles);
const canvas = element("canvas");
const state = { episode: episodes[0], step: 0, view: MERGED, speed: 3, timer: null, layers: new Set(LAYERS) };

const lastStep = () => state.episode.cell.length - 1;
const alongChart = (step) => 100 * step / (lastStep() || 1);
const percent = (part, whole) => `${(Math.floor(1000 * part / whole) / 10).toFixed(1)} %`; // 100 only when complete

function make(parent, tag, text = "", className = "") {
  const made = parent.appendChild(document.createElement(tag));
  made.textContent = text;
  made.className = className;
  return made;
}

// ---- changes of the state

function seek(step) {
  state.step = Math.min(Math.max(step, 0), lastStep());
  show();
}

function play() {
  if (state.step === lastStep()) state.step = 0;
  state.timer = setInterval(tick, 1000 / SPEEDS[state.speed]);
  show();
}

function pause() {
  clearInterval(state.timer);
  state.timer = null;
  show();
}

function toggle() {
  if (state.timer === null) play();
  else pause();
}

function tick() {
  seek(state.step + 1);
  if (state.step === lastStep()) pause();
}

/** A step by hand ends the playback. */
function stepTo(step) {
  pause();
  seek(step);
}

function changeSpeed(change) {
  const playing = state.timer !== null;
  if (playing) pause();
  state.speed = Math.min(Math.max(state.speed + change, 0), SPEEDS.length - 1);
  if (playing) play();
  show();
}

function setView(view) {
  state.view = view;
  show();
}

function toggleLayer(name) {
  if (!state.layers.delete(name)) state.layers.add(name);
  draw();
}

function openEpisode(episode) {
  state.episode = episode;
  if (typeof state.view === "number" && state.view >= episode.known_since.length) state.view = MERGED;
  const robots = episode.known_since.map((_, robot) => robot);
  buildChips("views", [TRUTH, MERGED, ...robots], setView);
  buildRobots(robots);
  drawCurves();
  resize();
  seek(state.step);
}

function nextEpisode() {
  openEpisode(episodes[(episodes.indexOf(state.episode) + 1) % episodes.length]);
}

// ---- what is built once per page or episode

/** A button per value, "Truth" for "truth" and a coloured number for a robot. */
function buildChips(id, values, pick) {
  element(id).replaceChildren();
  for (const value of values) {
    const robot = typeof value === "number";
    const text = robot ? String(value) : value.name ?? value[0].toUpperCase() + value.slice(1);
    const chip = make(element(id), "button", text);
    if (robot) {
      chip.setAttribute("aria-label", `Map of robot ${value}`);
      dot(chip, value);
    }
    chip.value = text;
    chip.addEventListener("click", () => pick(value));
  }
}

function buildLayers() {
  for (const name of LAYERS) {
    const label = make(element("layers"), "label", name);
    const box = document.createElement("input");
    box.type = "checkbox";
    box.checked = true;
    box.addEventListener("change", () => toggleLayer(name));
    label.prepend(box);
  }
}

function dot(parent, robot) {
  const made = document.createElement("i");
  made.className = "dot";
  made.style.background = robotColor(robot, colors);
  parent.prepend(made);
}

function buildRobots(robots) {
  element("robots").replaceChildren();
  for (const robot of robots) {
    const row = make(element("robots"), "tr");
    const name = make(row, "th", String(robot));
    name.scope = "row";
    dot(name, robot);
    make(row, "td", "", "known");
    make(row, "td");
  }
}

function drawCurves() {
  const { largest_targets, union_targets, num_targets } = state.episode;
  const curves = { largest: largest_targets, merged: union_targets };
  for (const [name, curve] of Object.entries(curves)) {
    const points = curve.map((known, step) => `${alongChart(step)},${100 - 100 * known / num_targets}`);
    document.querySelector(`#chart .${name}`).setAttribute("points", points.join(" "));
  }
  element("horizon").textContent = `step ${lastStep()}`;
}

/** Whole device pixels per cell, as many as the window has room for. */
function resize() {
  const { width, height } = state.episode, ratio = window.devicePixelRatio || 1;
  const tall = Math.max(240, window.innerHeight - 290);
  const room = Math.min(element("frame").clientWidth / width, tall / height);
  const scale = Math.max(1, Math.floor(room * ratio));
  [canvas.width, canvas.height] = [width * scale, height * scale];
  canvas.style.width = `${canvas.width / ratio}px`;
  draw();
}

// ---- what follows the state

function show() {
  const { episode, step } = state, share = (known) => percent(known, episode.num_targets);
  element("arena").textContent = `${episode.name} \u00b7 ${episode.height} \u00d7 ${episode.width} cells \u00b7 ${episode.known_since.length} robots`;
  element("step").textContent = `${step} / ${lastStep()}`;
  element("largest").textContent = share(episode.largest_targets[step]);
  element("merged").textContent = share(episode.union_targets[step]);
  showControls();
  showRobots();
  draw();
}

function showControls() {
  const playing = state.timer !== null, scrub = element("scrub");
  scrub.max = lastStep();
  scrub.value = state.step;
  scrub.setAttribute("aria-valuetext", `step ${state.step} of ${lastStep()}`);
  document.body.classList.toggle("playing", playing);
  element("play").setAttribute("aria-label", playing ? "Pause" : "Play");
  element("speed").textContent = `${SPEEDS[state.speed]} steps/s`;
  for (const axis of ["x1", "x2"]) document.querySelector("#chart .cursor").setAttribute(axis, alongChart(state.step));
  press("policies", (chip, index) => episodes[index] === state.episode);
  press("views", (chip) => chip.value.toLowerCase() === String(state.view));
}

function press(id, isPressed) {
  [...element(id).children].forEach((chip, index) => chip.setAttribute("aria-pressed", isPressed(chip, index)));
}

function showRobots() {
  const { episode, step } = state;
  [...element("robots").rows].forEach((row, robot) => {
    const known = episode.known_targets[step][robot], refused = episode.refused[step][robot];
    row.cells[1].textContent = percent(known, episode.num_targets);
    row.cells[1].style.setProperty("--share", known / episode.num_targets);
    const failed = hasFailed(episode, step, robot);
    row.cells[2].textContent = failed ? `failed at step ${episode.failed_since[robot]}` : lastAction(episode, step, robot);
    row.cells[2].classList.toggle("refused", Boolean(refused) || failed);
  });
}

function lastAction(episode, step, robot) {
  const action = episode.action[step][robot];
  if (action === undefined) return "\u2013"; // none led to the reset
  if (episode.refused[step][robot]) return `${ACTIONS[action]}, refused`;
  return action === COMMUNICATE ? `communicate, +${episode.received[step][robot]}` : ACTIONS[action];
}

function draw() {
  const style = getComputedStyle(document.documentElement);
  const theme = Object.fromEntries(THEME.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
  const scale = canvas.width / state.episode.width;
  const zoom = Math.max(1, 22 * (window.devicePixelRatio || 1) / scale);
  drawScene(canvas.getContext("2d"), { ...state, colors, theme, scale, zoom });
}

// ---- mouse, touch and keyboard

const BUTTONS = {
  first: () => stepTo(0),
  back: () => stepTo(state.step - 1),
  play: toggle,
  forward: () => stepTo(state.step + 1),
  last: () => stepTo(lastStep()),
  slower: () => changeSpeed(-1),
  faster: () => changeSpeed(1),
};

const KEYS = {
  " ": BUTTONS.play, ArrowLeft: BUTTONS.back, ArrowRight: BUTTONS.forward, Home: BUTTONS.first, End: BUTTONS.last,
  "-": BUTTONS.slower, "+": BUTTONS.faster, "=": BUTTONS.faster,
  t: () => setView(TRUTH), m: () => setView(MERGED), p: nextEpisode,
};

function onKey(event) {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.key === " " && event.target.closest("button, summary, [type=checkbox]")) return; // presses it
  const robot = /^\d$/.test(event.key) && event.key in state.episode.known_since;
  const act = robot ? () => setView(Number(event.key)) : KEYS[event.key];
  if (!act) return;
  event.preventDefault();
  act();
}

/** A drag across the canvas runs through the whole episode, a tap plays or pauses. */
function watchPointer() {
  let drag = null;
  canvas.addEventListener("pointerdown", (event) => {
    drag = { x: event.clientX, step: state.step, moved: false };
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!drag) return;
    const way = event.clientX - drag.x;
    drag.moved ||= Math.abs(way) > 6;
    if (drag.moved) stepTo(drag.step + Math.round(way / canvas.clientWidth * lastStep()));
  });
  canvas.addEventListener("pointerup", () => {
    if (drag && !drag.moved) toggle();
    drag = null;
  });
  canvas.addEventListener("pointercancel", () => { drag = null; });
}

function start() {
  for (const [id, act] of Object.entries(BUTTONS)) element(id).addEventListener("click", act);
  element("scrub").addEventListener("input", (event) => stepTo(Number(event.target.value)));
  document.addEventListener("keydown", onKey);
  // after a click the keys belong to the player again
  document.addEventListener("click", (event) => event.detail && document.activeElement.blur());
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  window.addEventListener("resize", resize);
  watchPointer();
  if (episodes.length > 1) buildChips("policies", episodes, openEpisode);
  buildLayers();
  openEpisode(episodes[0]);
}

start();
