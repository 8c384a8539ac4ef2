// Unpacks the recording that packing.py packed: differences become typed arrays, in m, s, rad, m/s.

const ACTIONS = ["lane left", "idle", "lane right", "accelerate", "decelerate"];
const LANE = [1, 0, -1, 0, 0]; // of an action: to the left, to the right

const SOURCES = ["truth", "own sensors", "CAM", "CPM"]; // cosim.types.Source
const UNSEEN = ["out of range", "hidden", "missed"]; // cosim.types.Unseen

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

function outline([x, y]) { // a polyline with its bounding box
  const px = scaled(x, 0.01), py = scaled(y, 0.01);
  return { x: px, y: py, box: [Math.min(...px), Math.min(...py), Math.max(...px), Math.max(...py)] };
}

function read(raw) {
  const lanes = raw.lanes.map(([id, width, internal, shape]) => ({ id, width: width / 100, internal: internal === 1, ...outline(shape) }));
  // a mission that was found, not named, may end almost anywhere: no use to mark that
  const open = raw.lanes.filter(([, , internal]) => internal === 0).length;
  const begin = raw.begin / 1000, times = Array.from(summed(raw.times), (t) => t / 1000 - begin);
  const data = {
    facts: raw.facts, begin, lamps: raw.lamps, words: [], vehicles: [], byId: new Map(), lanes,
    shapes: new Map(Object.entries(raw.shapes).map(([actor, [name, least, parts]]) => [Number(actor), { name, least, parts }])),
    times, end: times.length ? times[times.length - 1] : 0, decided: [], forecasts: [], beliefs: [], forecastInterval: raw.forecast_interval,
    corrections: [], violations: [], errors: [], collisions: [],
    signals: raw.signals.map(([states, frames]) => ({ states, frames: Array.from(summed(frames)) })),
    crossings: raw.crossings.map(([width, shape, signal]) => ({ width: width / 100, signal, ...outline(shape) })),
    stopLines: raw.stop_lines.map(([lane, rule, signals]) => ({ ...endOf(lanes[lane]), rule, signals })),
    junctions: raw.junctions.map(outline), goal: new Set(raw.goal.length > open / 2 && open > 6 ? [] : raw.goal), zones: new Set(raw.zones),
  };
  for (const [kind, rows] of [["words", raw.words], ["vehicles", raw.vehicles], ["interventions", raw.interventions],
    ["violations", raw.violations], ["errors", raw.errors], ["collisions", raw.collisions]]) {
    for (const row of rows) ADD[kind](data, row);
  }
  for (const [v, first, x, y, heading, speed, accel, lane] of raw.tracks) {
    data.vehicles[v].tracks.push({
      first, last: first + x.length - 1, x: scaled(x, 0.01, 2), y: scaled(y, 0.01, 2),
      heading: scaled(heading, 0.001), speed: scaled(speed, 0.01), accel: scaled(accel, 0.01), lane: summed(lane),
    });
  }
  raw.decided.forEach((t, k) => addDecisions(data, t, raw.choices[k], raw.forecasts[k], raw.beliefs[k]));
  return data;
}

// What happens once and stays, row by row, as packing.py makes them.
const ADD = {
  words: (data, text) => data.words.push(text),
  vehicles: (data, [id, kind, mission, driver, length, width, actor]) => {
    const { name, least } = data.shapes.get(actor);
    const vehicle = {
      id, number: data.vehicles.length, av: kind === 1, person: kind === 2, mission: mission === 1, driver, actor, what: name,
      length: Math.max(length / 100, least[0]), width: Math.max(width / 100, least[1]),
      tracks: [], choices: [], corrections: [], violations: [], errors: [],
    };
    data.vehicles.push(vehicle); data.byId.set(id, vehicle);
  },
  interventions: (data, row) => addSaid(data, "corrections", row),
  violations: (data, row) => addSaid(data, "violations", row),
  errors: (data, [t, until, v, kind, what, near]) => {
    const [text, whom] = [data.words[what], data.words[near]], vehicle = data.vehicles[v];
    const one = {
      t: t / 1000 - data.begin, until: until / 1000 - data.begin, vehicle, kind: data.words[kind].replaceAll("_", " "),
      text: text + (whom && !text.includes(whom) ? `, near ${whom}` : ""), near: whom,
    };
    data.errors.push(one); vehicle.errors.push(one);
  },
  collisions: (data, one) => data.collisions.push({ ...one, t: one.t / 1000 - data.begin }),
};

function addSaid(data, kind, [t, v, word]) {
  const one = { t: t / 1000 - data.begin, text: data.words[word], vehicle: data.vehicles[v] };
  data[kind].push(one); one.vehicle[kind].push(one);
}

function addDecisions(data, time, rows, forecast, beliefs) {
  const k = data.decided.length, t = time / 1000 - data.begin;
  data.decided.push(t);
  for (const [v, action, target, flags, blamed, blocked, q, score, ttc, unsafe] of rows) {
    data.vehicles[v].choices.push({
      k, t, action, target: target / 100, vetoed: (flags & 1) > 0, fallback: (flags & 2) > 0,
      blamed: data.words[blamed], blocked: data.words[blocked], q, score, ttc, unsafe,
    });
  }
  data.forecasts.push(forecast && new Map(forecast.map(([v, x, y, along, across]) => [v, {
    x: scaled(x, 0.1), y: scaled(y, 0.1), along: scaled(along, 0.1), across: scaled(across, 0.1),
  }])));
  data.beliefs.push(beliefs && new Map(beliefs.map(([av, known, unseen]) => [av, {
    known: new Map(known.map(([v, x, y, age, source]) => [v, { x: x / 10, y: y / 10, age: age / 10, source: SOURCES[source] }])),
    unseen: new Map(unseen.map(([v, why]) => [v, UNSEEN[why]])),
  }])));
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

// s that time lines span: the whole episode, also while it is driven.
function spanOf(data) { return Math.max(data.end, data.facts.duration || 0) || 1; }

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

// What the chosen AV knew at its last decision: { known, unseen }; null where it knew everything.
function beliefOf(data, vehicle, t) {
  const beliefs = vehicle && vehicle.av ? data.beliefs[atOrBefore(data.decided, t)] : null;
  return (beliefs && beliefs.get(vehicle.number)) || null;
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
    text: `${c.collider} hit ${c.victim} (${c.kind}${c.av_caused ? ", AV-caused" : ""}${c.human_error ? ", after a human error" : ""})`,
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
