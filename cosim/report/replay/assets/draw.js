// Draws one moment: road, predictions, vehicles, who is blamed, collisions.

const SIGMAS = 2; // half the width of a predicted interval, in standard deviations
const VIEW_RANGE = 125; // m: what a chosen AV's own rows reach (contract)

function colours() {
  const style = getComputedStyle(document.documentElement);
  const names = "ground road edge junction goal zone text quiet panel line pick halo av conservative moderate " +
    "aggressive asis mission bad good warn person mark dark sign law correction error";
  return Object.fromEntries(names.split(" ").map((n) => [n, style.getPropertyValue(`--${n}`).trim()]));
}

function colourOf(vehicle, c) {
  if (vehicle.mission) return c.mission;
  if (vehicle.av) return c.av;
  if (vehicle.person) return c.person;
  return c[vehicle.driver] || c.asis;
}

function drawRoad(ctx, data, view, c) {
  view.inMetres(ctx);
  ctx.lineJoin = "round";
  ctx.fillStyle = c.junction;
  for (const outline of data.junctions) if (view.sees(outline.box)) { trace(ctx, outline); ctx.closePath(); ctx.fill(); }
  const seen = data.lanes.map((lane, k) => k).filter((k) => view.sees(data.lanes[k].box));
  const line = Math.max(0.18, 0.8 / view.scale);
  for (const internal of [true, false]) {
    for (const k of seen) {
      const lane = data.lanes[k];
      if (lane.internal !== internal) continue;
      if (!internal && view.scale > 1.2) {
        ctx.strokeStyle = c.edge; ctx.lineWidth = lane.width + line; trace(ctx, lane); ctx.stroke();
      }
    }
    for (const k of seen) {
      const lane = data.lanes[k];
      if (lane.internal !== internal) continue;
      ctx.strokeStyle = data.goal.has(k) ? c.goal : data.zones.has(k) ? c.zone : c.road;
      ctx.lineWidth = Math.max(lane.width - (internal ? 0 : line), 1 / view.scale);
      trace(ctx, lane); ctx.stroke();
    }
  }
}

function drawForecast(ctx, state, view, c, t) {
  const { data, chosen } = state;
  const k = atOrBefore(data.decided, t);
  const forecast = data.forecasts[k];
  if (!forecast) return;
  const centre = chosen && chosen.av ? stateOf(data, chosen, t) : null;
  view.inMetres(ctx);
  for (const [number, path] of forecast) {
    const vehicle = data.vehicles[number];
    const now = stateOf(data, vehicle, data.decided[k]);
    if (!now || (centre && Math.hypot(now.x - centre.x, now.y - centre.y) > VIEW_RANGE)) continue;
    ctx.strokeStyle = ctx.fillStyle = colourOf(vehicle, c);
    ctx.globalAlpha = 0.75; ctx.lineWidth = Math.max(0.25, 1.2 / view.scale);
    ctx.beginPath(); ctx.moveTo(now.x, now.y);
    for (let i = 0; i < path.x.length; i++) ctx.lineTo(path.x[i], path.y[i]);
    ctx.stroke();
    const every = Math.max(Math.round(1 / data.forecastInterval), 1);
    for (let i = every - 1; i < path.x.length; i += every) { // one ellipse a second: the interval
      const j = i ? i - 1 : 0;
      const dx = path.x[i] - path.x[j], dy = path.y[i] - path.y[j];
      const heading = Math.hypot(dx, dy) > 0.5 ? Math.atan2(dy, dx) : now.heading; // standing: no direction of its own
      ctx.globalAlpha = 0.13;
      ctx.beginPath();
      ctx.ellipse(path.x[i], path.y[i], Math.max(SIGMAS * path.along[i], 0.3), Math.max(SIGMAS * path.across[i], 0.3), heading, 0, 7);
      ctx.fill();
      ctx.globalAlpha = 0.5; ctx.lineWidth = Math.max(0.08, 0.6 / view.scale); ctx.stroke();
    }
  }
  ctx.globalAlpha = 1;
}

// The polygons of an actor (shapes.py), `length` x `width` around the origin, in the colour of who drives.
function drawShape(ctx, shape, length, width, colour, c) {
  const fills = { body: colour, light: c.halo, dark: c.text };
  for (const [name, points] of shape) {
    ctx.fillStyle = fills[name];
    ctx.beginPath();
    for (const [x, y] of points) ctx.lineTo(x * length, y * width);
    ctx.closePath(); ctx.fill();
    if (name === "body") ctx.stroke();
  }
}

function drawVehicle(ctx, vehicle, s, c, view, chosen, shapes) {
  const slim = vehicle.person || vehicle.width < 1.2;
  const l = Math.max(vehicle.length, (slim ? 4 : 5) / view.scale), w = Math.max(vehicle.width, 3 / view.scale);
  ctx.save();
  view.inMetres(ctx);
  ctx.translate(s.x, s.y); ctx.rotate(s.heading);
  ctx.strokeStyle = chosen ? c.pick : c.ground; ctx.lineWidth = Math.max(chosen ? 0.35 : 0.12, (chosen ? 2 : 0.6) / view.scale);
  const shape = shapes.get(vehicle.actor).parts;
  drawShape(ctx, view.scale > 2.2 ? shape : shape.filter(([name]) => name === "body"), l, w, colourOf(vehicle, c), c);
  if (view.scale > 2.2) {
    if (s.accel < -1 && !slim) { ctx.fillStyle = "#ff2020"; ctx.fillRect(-l / 2, -w / 2, Math.min(0.09 * l, 0.6), w); } // brake lights
    if (vehicle.av) { ctx.fillStyle = c.halo; ctx.beginPath(); ctx.arc(-0.16 * l, 0, 0.2 * w, 0, 7); ctx.fill(); } // sensor
  }
  ctx.restore();
}

const YIELD = 1, STOPS = [2, 3]; // rules (cosim/road/link.py)

// A stop line, its sign and its lamps, at the end of a lane that leads to the right.
function drawStopLine(ctx, rule, lamps, side, c, fine) {
  ctx.fillStyle = c.mark;
  if (lamps.length || rule !== YIELD) ctx.fillRect(-0.5, -side, 0.5, 2 * side);
  else {
    for (let k = 0; k < 4; k++) {
      const y = side * (k / 2 - 1);
      ctx.beginPath(); ctx.moveTo(0, y); ctx.lineTo(0, y + side / 2); ctx.lineTo(-1.1, y + side / 4); ctx.fill();
    }
  }
  if (STOPS.includes(rule) && !lamps.length && fine) {
    for (const [size, colour] of [[1, c.mark], [0.8, c.sign]]) {
      ctx.fillStyle = colour; ctx.beginPath();
      for (let k = 0; k < 8; k++) ctx.lineTo(size * Math.cos((k + 0.5) * Math.PI / 4) + 1.2, size * Math.sin((k + 0.5) * Math.PI / 4));
      ctx.fill();
    }
  }
  const wide = (2 * side) / lamps.length;
  lamps.forEach((colour, k) => {
    ctx.fillStyle = colour;
    ctx.fillRect(0.15, side - (k + 1) * wide, 1.1, wide);
    if (fine) ctx.strokeRect(0.15, side - (k + 1) * wide, 1.1, wide);
  });
}

function drawSigns(ctx, data, view, c, t) {
  const near = view.scale > 1.5;
  if (view.scale < 0.4) return;
  view.inMetres(ctx);
  for (const crossing of near ? data.crossings : []) {
    if (!view.sees(crossing.box)) continue;
    ctx.strokeStyle = c.mark; ctx.lineWidth = crossing.width; ctx.setLineDash([0.5, 0.5]); ctx.lineDashOffset = -0.25;
    trace(ctx, crossing); ctx.stroke(); ctx.setLineDash([]);
    if (crossing.signal < 0) continue;
    ctx.fillStyle = data.lamps[lampAt(data, crossing.signal, t)] || c.asis; ctx.strokeStyle = c.dark; ctx.lineWidth = 0.15;
    for (const k of [0, crossing.x.length - 1]) { ctx.beginPath(); ctx.arc(crossing.x[k], crossing.y[k], 0.5, 0, 7); ctx.fill(); ctx.stroke(); }
  }
  for (const line of data.stopLines) {
    if (!view.sees([line.x, line.y, line.x, line.y]) || (!near && !line.signals.length)) continue;
    const lamps = line.signals.map((signal) => data.lamps[lampAt(data, signal, t)] || c.asis);
    ctx.save(); ctx.translate(line.x, line.y); ctx.rotate(line.heading);
    ctx.strokeStyle = c.dark; ctx.lineWidth = 0.15;
    if (!near) ctx.scale(1.5 / view.scale, 1); // seen from afar, too
    drawStopLine(ctx, line.rule, lamps, line.side, c, view.scale > 3);
    ctx.restore();
  }
}

function drawScene(ctx, state) {
  const { view, c } = state;
  view.inPixels(ctx);
  ctx.fillStyle = c.ground; ctx.fillRect(0, 0, view.width, view.height);
  const shown = new Map();
  view.eachRow(ctx, () => { for (const [vehicle, s] of drawRow(ctx, state)) shown.set(vehicle, s); });
  state.shown = [...shown];
  view.inPixels(ctx);
  ctx.fillStyle = c.line;
  for (let row = 1; row < view.rows; row++) {
    const y = row * view.high;
    ctx.fillRect(0, y - 0.5, view.width, 1);
    ctx.textAlign = "right"; ctx.textBaseline = "bottom"; ctx.font = "11px system-ui, sans-serif";
    halo(ctx, "goes on below \u2193", view.width - 8, y - 4, c.quiet, c); ctx.fillStyle = c.line;
  }
  drawScale(ctx, view, c);
}

// What one row shows of the road; returns the vehicles in it, with their states.
function drawRow(ctx, state) {
  const { data, view, c, t } = state;
  drawRoad(ctx, data, view, c);
  drawSigns(ctx, data, view, c, t);
  if (state.predictions) drawForecast(ctx, state, view, c, t);
  const shown = [];
  for (const vehicle of data.vehicles) {
    const s = stateOf(data, vehicle, t);
    if (s && view.sees([s.x - 8, s.y - 8, s.x + 8, s.y + 8])) shown.push([vehicle, s]);
  }
  for (const [vehicle, s] of shown) drawVehicle(ctx, vehicle, s, c, view, vehicle === state.chosen, data.shapes);
  view.inPixels(ctx);
  for (const [vehicle, s] of shown) { drawChoice(ctx, state, vehicle, s); drawLaw(ctx, state, vehicle, s); drawError(ctx, state, vehicle, s); drawBelief(ctx, state, vehicle, s); }
  for (const [vehicle, s] of shown) {
    const named = vehicle === state.chosen || vehicle.mission || (state.labels && view.scale > 1.5);
    const error = (named || view.scale > 3.5) && erring(vehicle, t);
    if (named || error) {
      const up = (Math.abs(Math.sin(s.heading)) * vehicle.length + vehicle.width) * 0.5 * view.scale + 9;
      const [px, py] = view.toPixels(s.x, s.y);
      const words = [named && vehicle.id, error && error.kind].filter(Boolean).join(": ");
      caption(ctx, words, px, py - up, error ? c.error : vehicle === state.chosen ? c.pick : c.text, c);
    }
  }
  for (const crash of data.collisions) if (crash.x != null && crash.t <= t + 0.05 && crash.t > t - 4) drawCrash(ctx, view, crash, c);
  return shown;
}

const SENSED = 200; // m around the chosen AV in which those it does not know of are marked
const DIFFERS = 0.4; // m from where a vehicle is: from there on the place it is taken to be at is drawn

// What the chosen AV knows of a vehicle: a dashed outline where it takes it to be, a cross where it knows of nobody.
function drawBelief(ctx, state, vehicle, s) {
  const { data, view, c, t, chosen } = state, belief = beliefOf(data, chosen, t);
  if (!belief || vehicle === chosen) return;
  const centre = stateOf(data, chosen, t), known = belief.known.get(vehicle.number), why = belief.unseen.get(vehicle.number);
  const [px, py] = view.toPixels(s.x, s.y);
  if (!known) {
    if (!centre || Math.hypot(s.x - centre.x, s.y - centre.y) > SENSED) return;
    ctx.strokeStyle = c.bad; ctx.lineWidth = 2; ctx.setLineDash([]);
    ctx.beginPath(); ctx.moveTo(px - 5, py - 5); ctx.lineTo(px + 5, py + 5); ctx.moveTo(px - 5, py + 5); ctx.lineTo(px + 5, py - 5); ctx.stroke();
    if (view.scale > 3.5) caption(ctx, why || "not known", px, py + 14, c.bad, c);
    return;
  }
  if (Math.hypot(known.x, known.y) < DIFFERS) return;
  const [gx, gy] = view.toPixels(s.x + known.x, s.y + known.y), l = vehicle.length * view.scale, w = vehicle.width * view.scale;
  ctx.strokeStyle = c.pick; ctx.lineWidth = 1.5; ctx.setLineDash([4, 3]);
  ctx.beginPath(); ctx.moveTo(px, py); ctx.lineTo(gx, gy); ctx.stroke();
  ctx.save(); ctx.translate(gx, gy); ctx.rotate(-s.heading); ctx.strokeRect(-l / 2, -w / 2, l, w); ctx.restore();
  ctx.setLineDash([]);
  if (view.scale > 3.5) caption(ctx, `${known.source}, ${known.age.toFixed(1)} s`, gx, gy - w / 2 - 9, c.pick, c);
}

// A command as a sign of w pixels, for a vehicle that drives to the right: + and - of speed, a bent arrow to a lane.
function drawCommand(ctx, action, w, colour, c) {
  ctx.lineCap = ctx.lineJoin = "round";
  const r = w / 2, up = LANE[action];
  for (const [style, width] of [[c.halo, 5], [colour, 2]]) {
    ctx.strokeStyle = style; ctx.lineWidth = width; ctx.beginPath();
    if (up) {
      ctx.moveTo(-r, up * 0.5 * r); ctx.lineTo(-0.3 * r, up * 0.5 * r); ctx.lineTo(0.6 * r, -up * 0.5 * r);
      ctx.moveTo(0, -up * 0.75 * r); ctx.lineTo(0.75 * r, -up * 0.6 * r); ctx.lineTo(0.6 * r, up * 0.1 * r);
    } else {
      ctx.moveTo(-0.6 * r, 0); ctx.lineTo(0.6 * r, 0);
      if (ACTIONS[action] === "accelerate") { ctx.moveTo(0, -0.6 * r); ctx.lineTo(0, 0.6 * r); }
    }
    ctx.stroke();
  }
}

// The command beside the vehicle, a ring where it was vetoed, and a line to whom the prioritizer blames.
function drawChoice(ctx, state, vehicle, s) {
  const { data, view, c, t } = state;
  const choice = vehicle.av ? choiceOf(data, vehicle, t) : null;
  if (!choice) return;
  const [px, py] = view.toPixels(s.x, s.y);
  if (choice.vetoed || choice.fallback) {
    ctx.strokeStyle = choice.fallback ? c.bad : c.warn; ctx.lineWidth = 2;
    ctx.beginPath(); ctx.arc(px, py, Math.max(0.62 * vehicle.length * view.scale, 6), 0, 7); ctx.stroke();
    const other = data.byId.get(choice.blamed), o = other && stateOf(data, other, t);
    if (o) {
      ctx.setLineDash([5, 4]); ctx.beginPath(); ctx.moveTo(px, py); ctx.lineTo(...view.toPixels(o.x, o.y)); ctx.stroke();
      ctx.setLineDash([]);
    }
  }
  if (view.scale > 2.2 && choice.action !== 1) {
    const below = (Math.abs(Math.sin(s.heading)) * vehicle.length + vehicle.width) * 0.5 * view.scale + 9;
    if (choice.blocked) { caption(ctx, "\u00d7", px, py + below, c.bad, c); return; }
    ctx.save(); ctx.translate(px, py + below);
    if (LANE[choice.action]) ctx.rotate(-s.heading);
    drawCommand(ctx, choice.action, 14, c.av, c);
    ctx.restore();
  }
}

const SHOWN = 2; // s that a correction or an offence stays marked

function lastOf(events, t, within = SHOWN) { // the last one that began at most so long ago
  const found = events.findLast((e) => e.t <= t + 0.05);
  return found && found.t > t - within ? found : null;
}

// A square where the car corrected its AV, and the words of an offence.
function drawLaw(ctx, { view, c, t }, vehicle, s) {
  const [px, py] = view.toPixels(s.x, s.y), broken = lastOf(vehicle.violations, t);
  if (lastOf(vehicle.corrections, t)) {
    const r = Math.max(0.62 * vehicle.length * view.scale, 6);
    ctx.strokeStyle = c.correction; ctx.lineWidth = 2; ctx.strokeRect(px - r, py - r, 2 * r, 2 * r);
  }
  if (!broken) return;
  ctx.font = "bold 12px system-ui, sans-serif"; ctx.textAlign = "center"; ctx.textBaseline = "middle";
  halo(ctx, broken.text, px, py + 0.62 * vehicle.length * view.scale + 20, c.law, c);
}

// The error under way, if any: of several the last one.
function erring(vehicle, t) { return vehicle.errors.findLast((e) => e.t <= t + 0.05 && e.until > t - 0.05) || null; }

// A warning triangle of `r` pixels.
function triangle(ctx, x, y, r, c) {
  ctx.lineJoin = "round"; ctx.fillStyle = c.panel; ctx.strokeStyle = c.error; ctx.lineWidth = 2;
  ctx.beginPath(); ctx.moveTo(x, y - r); ctx.lineTo(x + r, y + 0.8 * r); ctx.lineTo(x - r, y + 0.8 * r); ctx.closePath(); ctx.fill(); ctx.stroke();
  ctx.fillStyle = c.error; ctx.fillRect(x - 1, y - 0.35 * r, 2, 0.55 * r); ctx.fillRect(x - 1, y + 0.35 * r, 2, 2);
}

// A triangle on who errs, and a line to whom it meets first.
function drawError(ctx, { data, view, c, t }, vehicle, s) {
  const error = erring(vehicle, t);
  if (!error) return;
  const [px, py] = view.toPixels(s.x, s.y), other = data.byId.get(error.near), o = other && stateOf(data, other, t);
  if (o) {
    ctx.strokeStyle = c.error; ctx.lineWidth = 1.5; ctx.setLineDash([2, 4]);
    ctx.beginPath(); ctx.moveTo(px, py); ctx.lineTo(...view.toPixels(o.x, o.y)); ctx.stroke(); ctx.setLineDash([]);
  }
  triangle(ctx, px, py, 8, c);
}

function halo(ctx, text, x, y, colour, c) {
  ctx.strokeStyle = c.halo; ctx.lineWidth = 4; ctx.lineJoin = "round"; ctx.strokeText(text, x, y);
  ctx.fillStyle = colour; ctx.fillText(text, x, y);
}

function caption(ctx, text, x, y, colour, c) {
  ctx.font = "11px system-ui, sans-serif"; ctx.textAlign = "center"; ctx.textBaseline = "middle";
  halo(ctx, text, x, y, colour, c);
}

function drawCrash(ctx, view, crash, c) {
  const [px, py] = view.toPixels(crash.x, crash.y);
  ctx.strokeStyle = c.bad; ctx.lineWidth = 3;
  ctx.beginPath(); ctx.arc(px, py, 16, 0, 7);
  ctx.moveTo(px - 9, py - 9); ctx.lineTo(px + 9, py + 9); ctx.moveTo(px - 9, py + 9); ctx.lineTo(px + 9, py - 9); ctx.stroke();
  ctx.font = "bold 12px system-ui, sans-serif"; ctx.textAlign = "center";
  halo(ctx, `${crash.collider} hit ${crash.victim}`, px, py - 25, c.bad, c);
}

function drawScale(ctx, view, c) {
  const metres = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000].find((m) => m * view.scale > 60) || 5000;
  const y = view.height - 14, right = view.width - 14, left = right - metres * view.scale;
  ctx.strokeStyle = c.text; ctx.lineWidth = 1.5;
  ctx.beginPath(); ctx.moveTo(left, y - 4); ctx.lineTo(left, y); ctx.lineTo(right, y); ctx.lineTo(right, y - 4); ctx.stroke();
  caption(ctx, `${metres} m`, (left + right) / 2, y - 9, c.text, c);
}

// The whole net in small, where everybody is, and what the large picture shows.
function drawMap(canvas, state) {
  const small = state.map, { data, view, c } = state, ctx = canvas.getContext("2d");
  small.inPixels(ctx); ctx.clearRect(0, 0, small.width, small.height);
  small.inMetres(ctx); ctx.strokeStyle = c.quiet; ctx.globalAlpha = 0.45;
  for (const lane of data.lanes) { ctx.lineWidth = Math.max(lane.width, 1 / small.scale); trace(ctx, lane); ctx.stroke(); }
  ctx.globalAlpha = 1; small.inPixels(ctx);
  for (const vehicle of data.vehicles) {
    const s = stateOf(data, vehicle, state.t);
    if (!s) continue;
    const [px, py] = small.toPixels(s.x, s.y), r = vehicle.mission || vehicle === state.chosen ? 3 : 1.4;
    ctx.fillStyle = colourOf(vehicle, c); ctx.beginPath(); ctx.arc(px, py, r, 0, 7); ctx.fill();
  }
  const wide = view.width / view.scale, h = view.high / 2 / view.scale, left = view.x - (view.main + 0.5) * wide;
  const [x0, y0] = small.toPixels(left, view.y + h), [x1, y1] = small.toPixels(left + view.rows * wide, view.y - h);
  ctx.strokeStyle = c.pick; ctx.lineWidth = 1; ctx.strokeRect(x0, y0, Math.max(x1 - x0, 3), Math.max(y1 - y0, 3));
}
