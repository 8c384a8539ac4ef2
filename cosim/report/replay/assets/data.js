// Unpacks the recording that packing.py packed: differences become typed arrays, in m, s, rad, m/s.

const ACTIONS = ["lane left", "idle", "lane right", "accelerate", "decelerate"];
const GLYPHS = ["\u2190", "\u00b7", "\u2192", "\u2191", "\u2193"];

function summed(steps, order = 1) {
  const values = Float64Array.from(steps);
  for (let n = 0; n < order; n++) for (let k = 1; k < values.length; k++) values[k] += values[k - 1];
  return values;
}

function scaled(steps, unit, order = 1) { return summed(steps, order).map((v) => v * unit); }

async function unpack(base64) {
  const bytes = Uint8Array.from(atob(base64), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return read(await new Response(stream).json());
}

function read(raw) {
  const begin = raw.begin / 1000;
  const line = ([x, y]) => { // a polyline with its bounding box
    const px = scaled(x, 0.01), py = scaled(y, 0.01);
    return { x: px, y: py, box: [Math.min(...px), Math.min(...py), Math.max(...px), Math.max(...py)] };
  };
  const shapes = new Map(Object.entries(raw.shapes).map(([actor, [name, least, parts]]) => [Number(actor), { name, least, parts }]));
  const vehicles = raw.vehicles.map(([id, kind, mission, driver, length, width, actor], number) => ({
    id, number, av: kind === 1, person: kind === 2, mission: mission === 1, driver, actor, what: shapes.get(actor).name,
    length: Math.max(length / 100, shapes.get(actor).least[0]), width: Math.max(width / 100, shapes.get(actor).least[1]),
    tracks: [], choices: [], corrections: [], violations: [], errors: [],
  }));
  for (const [v, first, x, y, heading, speed, accel, lane] of raw.tracks) {
    vehicles[v].tracks.push({
      first, last: first + x.length - 1, x: scaled(x, 0.01, 2), y: scaled(y, 0.01, 2),
      heading: scaled(heading, 0.001), speed: scaled(speed, 0.01), accel: scaled(accel, 0.01), lane: summed(lane),
    });
  }
  const said = ([t, v, word]) => ({ t: t / 1000 - begin, text: raw.words[word], vehicle: vehicles[v] });
  const corrections = raw.interventions.map(said), violations = raw.violations.map(said);
  const errors = raw.errors.map(([t, until, v, kind, what, near]) => ({
    t: t / 1000 - begin, until: until / 1000 - begin, vehicle: vehicles[v], kind: raw.words[kind].replaceAll("_", " "),
    text: raw.words[what] + (raw.words[near] && !raw.words[what].includes(raw.words[near]) ? `, near ${raw.words[near]}` : ""), near: raw.words[near],
  }));
  for (const one of errors) one.vehicle.errors.push(one);
  for (const one of corrections) one.vehicle.corrections.push(one);
  for (const one of violations) one.vehicle.violations.push(one);
  const decided = raw.decided.map((t) => t / 1000 - begin);
  raw.choices.forEach((rows, k) => {
    for (const [v, action, target, flags, blamed, blocked, q, score, ttc, unsafe] of rows) {
      vehicles[v].choices.push({
        k, t: decided[k], action, target: target / 100, vetoed: (flags & 1) > 0, fallback: (flags & 2) > 0,
        blamed: raw.words[blamed], blocked: raw.words[blocked], q, score, ttc, unsafe,
      });
    }
  });
  const forecasts = raw.forecasts.map((rows) => rows && new Map(rows.map(([v, x, y, along, across]) => [v, {
    x: scaled(x, 0.1), y: scaled(y, 0.1), along: scaled(along, 0.1), across: scaled(across, 0.1),
  }])));
  const times = summed(raw.times).map((t) => t / 1000 - begin);
  // a mission that was found, not named, may end almost anywhere: no use to mark that
  const open = raw.lanes.filter(([, , internal]) => internal === 0).length;
  const lanes = raw.lanes.map(([id, width, internal, shape]) => ({ id, width: width / 100, internal: internal === 1, ...line(shape) }));
  return {
    facts: raw.facts, shapes, lamps: raw.lamps, corrections, violations, errors,
    signals: raw.signals.map(([states, frames]) => ({ states, frames: summed(frames) })),
    crossings: raw.crossings.map(([width, shape, signal]) => ({ width: width / 100, signal, ...line(shape) })),
    stopLines: raw.stop_lines.map(([lane, rule, signals]) => ({ ...endOf(lanes[lane]), rule, signals })),
    times, end: times[times.length - 1], vehicles, decided, forecasts,
    forecastInterval: raw.forecast_interval,
    byId: new Map(vehicles.map((v) => [v.id, v])),
    lanes,
    junctions: raw.junctions.map(line), goal: new Set(raw.goal.length > open / 2 && open > 6 ? [] : raw.goal), zones: new Set(raw.zones),
    collisions: raw.collisions.map((c) => ({ ...c, t: c.t / 1000 - begin })),
  };
}

// Where a lane ends, in which direction, and half its width between the edges.
function endOf({ x, y, width }) {
  const n = x.length - 1;
  return { x: x[n], y: y[n], heading: Math.atan2(y[n] - y[n - 1], x[n] - x[n - 1]), side: 0.46 * width };
}

// The state of a signal (rRyYgGsuoO) at time t.
function lampAt(data, signal, t) {
  const { states, frames } = data.signals[signal];
  return states[Math.max(atOrBefore(frames, Math.max(atOrBefore(data.times, t), 0)), 0)];
}

// The last index of an ascending array whose value is not above t; -1 before the first.
function atOrBefore(sorted, t) {
  let low = 0, high = sorted.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (sorted[middle] <= t + 1e-6) low = middle + 1; else high = middle;
  }
  return low - 1;
}

// Where a vehicle is at time t, between two frames on the straight line; null when it is not on the road.
function stateOf(data, vehicle, t) {
  const k = Math.max(atOrBefore(data.times, t), 0);
  for (const track of vehicle.tracks) {
    if (k < track.first || k > track.last) continue;
    const i = k - track.first, j = Math.min(i + 1, track.last - track.first);
    const span = k + 1 < data.times.length ? data.times[k + 1] - data.times[k] : 1;
    const u = Math.min(Math.max((t - data.times[k]) / span, 0), 1);
    const mix = (column) => column[i] + u * (column[j] - column[i]);
    return { x: mix(track.x), y: mix(track.y), heading: mix(track.heading), speed: mix(track.speed),
      accel: mix(track.accel), lane: track.lane[i] };
  }
  return null;
}

// What an AV decided last, while it still holds; null when SUMO drives it.
function choiceOf(data, vehicle, t) {
  const k = atOrBefore(data.decided, t);
  let low = 0, high = vehicle.choices.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (vehicle.choices[middle].k <= k) low = middle + 1; else high = middle;
  }
  const choice = vehicle.choices[low - 1];
  return choice && choice.k === k ? choice : null;
}

// Kinds of events, the gravest first: what the filter calls them, and their colour.
const EVENTS = {
  collision: ["collisions", "bad"], law: ["law broken", "law"], error: ["human errors", "error"], unsafe: ["no safe action", "aggressive"],
  mission: ["mission", "good"], correction: ["corrections by the car", "correction"],
  refused: ["commands refused", "quiet"], veto: ["vetoes", "warn"],
};

// What there is to jump to; vetoes and refusals where they begin.
function eventsOf(data) {
  const found = data.collisions.map((c) => ({
    t: c.t, kind: "collision", who: [c.collider, c.victim],
    text: `${c.collider} hit ${c.victim} (${c.kind}${c.av_caused ? ", AV-caused" : ""}${c.human_error ? ", a human had erred" : ""})`,
  }));
  for (const one of data.violations) found.push({ t: one.t, kind: "law", who: [one.vehicle.id], text: `${one.vehicle.id} ${one.text}` });
  for (const one of data.errors) { // of the warm-up none
    if (one.t > 0) found.push({ t: one.t, kind: "error", who: [one.vehicle.id, one.near], text: `${one.vehicle.id} ${one.text} (${one.kind})` });
  }
  for (const one of data.corrections) {
    found.push({ t: one.t, kind: "correction", who: [one.vehicle.id], text: `${one.vehicle.id}: corrected by the car, ${one.text}` });
  }
  const figure = (name) => (data.facts.metrics.find(([n]) => n === name) || [])[1];
  if (figure("mission_time_s") != null) {
    found.push({ t: figure("mission_time_s"), kind: "mission", who: data.vehicles.filter((v) => v.mission).map((v) => v.id),
      text: "mission fulfilled" });
  }
  for (const v of data.vehicles) {
    let before = null;
    for (const c of v.choices) {
      const goesOn = before && before.k === c.k - 1;
      if (c.blocked && !(goesOn && before.blocked === c.blocked)) {
        found.push({ t: c.t, kind: "refused", who: [v.id], text: `${v.id}: ${ACTIONS[c.action]} blocked, ${c.blocked}` });
      }
      if (c.fallback && !(goesOn && before.fallback)) {
        found.push({ t: c.t, kind: "unsafe", who: [v.id], text: `${v.id}: no safe action, takes ${ACTIONS[c.action]}` });
      } else if (c.vetoed && !(goesOn && before.vetoed)) {
        found.push({ t: c.t, kind: "veto", who: [v.id, c.blamed], text: `${v.id}: ${preferred(c)} vetoed, blamed ${c.blamed}` });
      }
      before = c;
    }
  }
  return found.sort((a, b) => a.t - b.t);
}

// Actions that share the highest value; several while a network is untrained.
function best(choice) {
  const top = choice.q ? Math.max(...choice.q) : NaN;
  return choice.q ? ACTIONS.map((_, a) => a).filter((a) => choice.q[a] === top) : [];
}

function preferred(choice) {
  const tied = best(choice);
  return tied.length === 1 ? ACTIONS[tied[0]] : "preferred action";
}
