"use strict";
// Draws one step of an episode. Units are cells: x is the column, y the row.

const TRUTH = "truth", MERGED = "merged"; // the other views are robots' numbers
const DISC = 0.36; // radius of a robot

/** Step from which each cell counts as known in a view; what only failed robots knew is lost. */
function knownSince(episode, view, step) {
  const own = episode.known_since;
  if (view === TRUTH) return own[0].map(() => 0);
  if (view !== MERGED) return own[view];
  const living = own.filter((_, robot) => !hasFailed(episode, step, robot));
  return own[0].map((_, cell) => Math.min(...living.map((robot) => robot[cell])));
}

function hasFailed(episode, step, robot) {
  return episode.failed_since[robot] <= step;
}

/** Cells above, below, left and right of a cell, inside the arena. */
function neighbours(episode, cell) {
  const { width, height } = episode, column = cell % width, found = [];
  if (cell >= width) found.push(cell - width);
  if (cell < width * (height - 1)) found.push(cell + width);
  if (column > 0) found.push(cell - 1);
  if (column < width - 1) found.push(cell + 1);
  return found;
}

/** Centre of a cell. */
function centre(episode, cell) {
  return [cell % episode.width + 0.5, Math.floor(cell / episode.width) + 0.5];
}

/** A robot's colour; their palette repeats. */
function robotColor(robot, colors) {
  return colors[robot % colors.length];
}

/** Black or white, whichever is read better on a colour "#rrggbb". */
function textOn(color) {
  const [red, green, blue] = [1, 3, 5].map((at) => parseInt(color.slice(at, at + 2), 16));
  return 0.299 * red + 0.587 * green + 0.114 * blue > 140 ? "#000" : "#fff";
}

/**
 * Draw a step.
 * scene: { episode, step, view, colors (of robots), layers (Set of names), theme (colours of the
 * rest), scale (device pixels per cell), zoom (of robots, arrows and lines; above 1 on small cells) }.
 */
function drawScene(context, scene) {
  const layer = (name, draw) => scene.layers.has(name) && draw(context, scene);
  context.setTransform(scene.scale, 0, 0, scene.scale, 0, 0);
  context.lineCap = context.lineJoin = "round";
  drawCells(context, scene);
  layer("Sight", drawSight);
  layer("Trails", drawTrails);
  layer("Links", drawLinks);
  layer("Arrows", drawArrows);
  drawWalkers(context, scene);
  drawRobots(context, scene);
}

function drawCells(context, { episode, step, view, layers, theme, scale }) {
  const since = knownSince(episode, view, step);
  const gap = 1 / scale; // a hair line between cells
  context.fillStyle = theme.grid;
  context.fillRect(0, 0, episode.width, episode.height);
  since.forEach((first, cell) => {
    const wall = episode.walls.has(cell), known = first <= step;
    const frontier = layers.has("Frontiers") && known && !wall
      && neighbours(episode, cell).some((beside) => since[beside] > step);
    context.fillStyle = !known ? theme.unknown : wall ? theme.obstacle : frontier ? theme.frontier : theme.free;
    context.fillRect(cell % episode.width, Math.floor(cell / episode.width), 1 - gap, 1 - gap);
  });
}

/** Robots as [number, cell, colour, strength]: strong where the view is theirs or everybody's. */
function robotsOf({ episode, step, view, colors }) {
  return episode.cell[step].map((cell, robot) => {
    const strength = view === TRUTH || view === MERGED || view === robot ? 1 : 0.4;
    return [robot, cell, robotColor(robot, colors), strength];
  });
}

/** The same, of robots that have not failed. */
function livingOf(scene) {
  return robotsOf(scene).filter(([robot]) => !hasFailed(scene.episode, scene.step, robot));
}

/** The outline of what each robot sees. */
function drawSight(context, scene) {
  const { episode, step } = scene, radius = episode.fov_radius + 0.45;
  for (const [robot, cell, color, strength] of livingOf(scene)) {
    const [x, y] = centre(episode, cell);
    context.strokeStyle = color;
    context.lineWidth = 0.06 * scene.zoom;
    context.globalAlpha = 0.8 * strength;
    if (episode.seen) outline(context, seenCells(episode, episode.seen[step][robot], x, y));
    else context.strokeRect(x - radius, y - radius, 2 * radius, 2 * radius);
  }
  context.globalAlpha = 1;
}

/** Cells "column,row" that a robot at a centre sees, from the bits of its window. */
function seenCells(episode, bits, x, y) {
  const radius = episode.fov_radius, side = 2 * radius + 1, cells = new Set();
  for (let at = 0; at < side * side; at += 1) {
    if (!(parseInt(bits[at >> 2], 16) & (8 >> (at & 3)))) continue;
    const column = Math.floor(x) - radius + at % side, row = Math.floor(y) - radius + Math.floor(at / side);
    cells.add(`${column},${row}`);
  }
  return cells;
}

/** Stroke the sides at which a set of cells "column,row" ends. */
function outline(context, cells) {
  context.beginPath();
  for (const cell of cells) {
    const [column, row] = cell.split(",").map(Number);
    const sides = [[0, -1, 0, 0, 1, 0], [0, 1, 0, 1, 1, 1], [-1, 0, 0, 0, 0, 1], [1, 0, 1, 0, 1, 1]];
    for (const [across, along, fromX, fromY, toX, toY] of sides) {
      if (cells.has(`${column + across},${row + along}`)) continue;
      context.moveTo(column + fromX, row + fromY);
      context.lineTo(column + toX, row + toY);
    }
  }
  context.stroke();
}

function drawTrails(context, scene) {
  const { episode, step } = scene;
  for (const [robot, , color, strength] of robotsOf(scene)) {
    const aside = 0.06 * (robot % 5 - 2); // paths over the same cells run side by side
    context.beginPath();
    for (const row of episode.cell.slice(0, step + 1)) {
      const [x, y] = centre(episode, row[robot]);
      context.lineTo(x + aside, y + aside);
    }
    context.globalAlpha = 0.65 * strength;
    context.strokeStyle = color;
    context.lineWidth = 0.07 * scene.zoom;
    context.stroke();
  }
  context.globalAlpha = 1;
}

function drawLinks(context, scene) {
  drawPairs(context, scene, scene.episode.linked[scene.step], 0.05, 0.7);
  drawPairs(context, scene, scene.episode.merging[scene.step], 0.2, 1);
}

function drawPairs(context, { episode, step, theme, zoom }, pairs, width, alpha) {
  context.beginPath();
  for (const [one, other] of pairs) {
    context.moveTo(...centre(episode, episode.cell[step][one]));
    context.lineTo(...centre(episode, episode.cell[step][other]));
  }
  context.globalAlpha = alpha;
  context.strokeStyle = theme.link;
  context.lineWidth = width * zoom;
  context.stroke();
  context.globalAlpha = 1;
}

/** A robot's table per direction: length is the share of its paths, width how near they end. */
function drawArrows(context, scene) {
  const { episode, step } = scene;
  for (const [robot, cell, color, strength] of livingOf(scene)) {
    if (strength < 1) continue; // what the others know is not on this map
    const paths = episode.paths[step][robot], length = episode.path_length[step][robot];
    const all = paths.reduce((sum, count) => sum + count, 0);
    const nearest = Math.min(...length.filter((_, direction) => paths[direction] > 0));
    paths.forEach((count, direction) => {
      if (!count) return;
      const size = { long: 0.4 + 1.2 * count / all, wide: 0.06 + 0.16 * nearest / length[direction] };
      drawArrow(context, scene, cell, direction, size, color);
    });
  }
}

/** An arrow from a robot's rim; directions go clockwise from north in eighths of a turn. */
function drawArrow(context, { episode, theme, zoom }, cell, direction, { long, wide }, color) {
  const head = 0.3;
  context.save();
  context.translate(...centre(episode, cell));
  context.scale(zoom, zoom);
  context.rotate(direction * Math.PI / 4);
  context.beginPath();
  const tip = -DISC - long;
  const corners = [[-wide / 2, -DISC + 0.05], [-wide / 2, tip + head], [-wide / 2 - 0.1, tip + head], [0, tip]];
  for (const [across, along] of corners) context.lineTo(across, along);
  for (const [across, along] of corners.reverse()) context.lineTo(-across, along);
  context.closePath();
  context.lineWidth = 0.06;
  context.strokeStyle = theme.outline;
  context.stroke();
  context.fillStyle = color;
  context.fill();
  context.restore();
}

function drawRobots(context, scene) {
  const { episode, step, theme, zoom } = scene;
  const merging = new Set(scene.layers.has("Links") ? episode.merging[step].flat() : []);
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.font = "600 0.44px system-ui, sans-serif";
  for (const [robot, cell, color, strength] of robotsOf(scene)) {
    const [rim, rimColor] = merging.has(robot) ? [0.1, theme.link] : [0.05, theme.outline];
    context.save();
    context.translate(...centre(episode, cell));
    context.scale(zoom, zoom);
    const failed = hasFailed(episode, step, robot);
    context.globalAlpha = failed ? 0.6 : strength;
    disc(context, DISC + rim, rimColor);
    disc(context, DISC, color);
    context.fillStyle = context.strokeStyle = textOn(color);
    context.fillText(robot, 0, 0.02);
    if (failed) cross(context);
    context.restore();
  }
}

/** A cross over a robot that has failed. */
function cross(context) {
  context.beginPath();
  for (const side of [-1, 1]) {
    context.moveTo(-0.25 * side, -0.25);
    context.lineTo(0.25 * side, 0.25);
  }
  context.lineWidth = 0.1;
  context.stroke();
}

/** People who walk about, as squares that stand on a corner. */
function drawWalkers(context, { episode, step, theme, zoom }) {
  for (const cell of episode.walkers[step] ?? []) {
    context.save();
    context.translate(...centre(episode, cell));
    context.scale(zoom, zoom);
    context.rotate(Math.PI / 4);
    context.fillStyle = theme.walker;
    context.fillRect(-0.24, -0.24, 0.48, 0.48);
    context.lineWidth = 0.06;
    context.strokeStyle = theme.outline;
    context.strokeRect(-0.24, -0.24, 0.48, 0.48);
    context.restore();
  }
}

function disc(context, radius, color) {
  context.beginPath();
  context.arc(0, 0, radius, 0, 2 * Math.PI);
  context.fillStyle = color;
  context.fill();
}
