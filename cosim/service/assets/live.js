// The live page: starts a session or joins one, asks for as much of it as its own clock needs, draws it as it comes.

const KEPT = 400_000; // vehicle frames; of more the older half is forgotten
const FORECASTS = 250; // decisions whose predictions are kept

let catalogue = null, session = null, socket = null, player = null, road = null, data = null;
let explains = false, explained = ""; // whether the chosen AV's choices are to be explained; whose are
let asked = 0, wanted = true, behind = false; // s asked for; whether it plays when an episode begins; whether the user looks back

const live = {
  // s of the episode that pass in a s of the clock at speed 1; asks for what comes
  pace(state) {
    const ahead = data.end - state.t, lead = 0.6 + 0.4 * Math.max(state.rate, 1);
    if (!session.program) {
      this.pull(state.t + lead);
      return Math.min(Math.max(ahead / (0.5 * lead), 0.05), 1);
    }
    return behind ? 1 : Math.max(ahead / lead, 0.05); // somebody else's pace
  },
  pull(until) {
    if (session.program || data.over || (until <= asked && asked > data.end)) return;
    asked = until + 0.4;
    send({ until: asked });
  },
  ended() { if ($("on").checked && !session.program) send({ next: true }); },
  dark: () => THEME.dark,
  darken: (on) => { THEME.dark = on; },
  keys: [["r", "this seed again", () => $("again").click()], ["e", "the next seed", () => $("next").click()],
    ["x", "explain the chosen AV: what each input changes", () => $("why").click()], ["s", "another scenario", () => $("other").click()]],
};

function send(message) { if (socket && socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message)); }

// Has the choices of the chosen AV explained, where that is wanted.
function explain() {
  const chosen = player && player.state.chosen, av = explains && chosen && chosen.av ? chosen.id : "";
  if (av !== explained) { explained = av; send({ explain: av }); }
}

function say(text, bad = false) {
  $("said").textContent = text; $("said").hidden = !text; $("said").classList.toggle("bad", bad);
}

// ---- what the server tells ----

function told(message) {
  if (message.problem) { say(message.problem, true); return; }
  if (message.ended) { leave(`The session has ended: ${message.ended}.`); return; }
  if (message.road) road = message.road;
  const begins = Boolean(message.episode);
  if (begins) {
    const none = { times: [], tracks: [], decided: [], choices: [], forecasts: [], beliefs: [], forecast_interval: null, words: [], vehicles: [],
      interventions: [], violations: [], errors: [], collisions: [] };
    data = read({ ...road, ...none, ...message.episode, signals: Array.from({ length: message.episode.signals }, () => ["", []]) });
    data.kept = 0; asked = 0; behind = false;
  }
  for (const [kind, row] of message.add || []) ADD[kind](data, row);
  let figures = begins;
  for (const step of message.steps || []) figures = addStep(step) || figures;
  if (begins) begin(); else player.grown();
  explain();
  if (figures) { fillFigures(data); fillHead(data); fillTally(); }
}

// One decision: what was decided, then the frames that it led to. Returns whether figures came along.
function addStep(step) {
  if (step.decided) {
    const [t, choices, forecast, beliefs] = step.decided;
    if (step.interval) data.forecastInterval = step.interval;
    addDecisions(data, t, choices, forecast, beliefs);
    if (step.uses) {
      const of = data.vehicles[step.uses[0]].choices;
      if (of.length) of[of.length - 1].uses = step.uses[1];
    }
    for (const drawn of [data.forecasts, data.beliefs]) if (drawn.length > FORECASTS) drawn[drawn.length - FORECASTS - 1] = null;
  }
  for (const frame of step.frames) addFrame(frame);
  data.over = step.over;
  if (step.facts) Object.assign(data.facts, step.facts);
  return Boolean(step.facts);
}

function addFrame([time, numbers, x, y, heading, speed, accel, lane, signals]) {
  const k = data.times.length, t = time / 1000 - data.begin;
  data.times.push(t); data.end = t; data.kept += numbers.length;
  numbers.forEach((v, i) => {
    const tracks = data.vehicles[v].tracks;
    let track = tracks[tracks.length - 1];
    if (!track || track.last !== k - 1) {
      track = { first: k, last: k - 1, x: [], y: [], heading: [], speed: [], accel: [], lane: [] };
      tracks.push(track);
    }
    const now = heading[i] / 1000, before = track.heading.length ? track.heading[track.heading.length - 1] : now;
    track.last = k;
    track.x.push(x[i] / 100); track.y.push(y[i] / 100); track.speed.push(speed[i] / 100); track.accel.push(accel[i] / 100);
    track.heading.push(now - 2 * Math.PI * Math.round((now - before) / (2 * Math.PI))); // no jump at a full turn
    track.lane.push(lane[i]);
  });
  data.signals.forEach((one, s) => {
    if (one.states[one.states.length - 1] !== signals[s]) { one.states += signals[s]; one.frames.push(k); }
  });
  if (data.kept > KEPT) forget(data.times.length >> 1);
}

// The first n frames, and what was decided in them.
function forget(n) {
  data.times.splice(0, n); data.kept = 0;
  const gone = Math.max(atOrBefore(data.decided, data.times[0]), 0);
  data.decided.splice(0, gone); data.forecasts.splice(0, gone); data.beliefs.splice(0, gone);
  for (const vehicle of data.vehicles) {
    vehicle.choices = vehicle.choices.filter((c) => c.k >= gone);
    for (const choice of vehicle.choices) choice.k -= gone;
    vehicle.tracks = vehicle.tracks.filter((track) => track.last >= n);
    for (const track of vehicle.tracks) {
      const cut = Math.max(n - track.first, 0);
      for (const column of ["x", "y", "heading", "speed", "accel", "lane"]) track[column].splice(0, cut);
      track.first = Math.max(track.first - n, 0); track.last -= n;
      data.kept += track.x.length;
    }
  }
  for (const one of data.signals) {
    const kept = Math.max(atOrBefore(one.frames, n), 0);
    one.states = one.states.slice(kept); one.frames = one.frames.slice(kept).map((k) => Math.max(k - n, 0));
  }
  if (player && player.state.t < data.times[0]) player.state.t = data.times[0];
}

function begin() {
  document.body.classList.remove("idle"); say("");
  $("start").hidden = true;
  if (player) player.load(data);
  else {
    player = start(data, live);
    const seek = player.state.seek;
    player.state.seek = (t) => { behind = t < data.end - 2; seek(t); };
  }
  document.title = `${data.facts.scenario} / ${data.facts.policy} \u2013 cosim`;
  if (wanted) player.play(true);
}

// ---- figures ----

function fillTally() {
  const figure = (name) => (data.facts.metrics.find(([n]) => n === name) || [])[1], tally = data.facts.tally;
  const lines = (id, first, second) => $(id).replaceChildren(element("b", first), element("small", second));
  const before = (found) => (found ? shareText(found) : "no episode is finished yet");
  lines("crashes", tally.crashed ? `${(100 * tally.crashed.value).toFixed(1)} %` : "\u2013", before(tally.crashed));
  lines("missions", tally.mission_success ? `${(100 * tally.mission_success.value).toFixed(1)} %` : "\u2013",
    figure("mission_success") == null ? "none in this scenario" : before(tally.mission_success));
  lines("distance", number(figure("dt_mean_m"), 0, " m"), `AVs ${number(figure("dt_av_m"), 0)}, mission ${number(figure("dt_mission_m"), 0)} m`);
  const who = ["av", "hv"].map((kind) => number(figure(`total_delay_${kind}_s`), 1)), wait = number(figure("longest_wait_s"), 0, " s");
  lines("everybody", number(figure("total_delay_s"), 1, " s"),
    `AVs ${who[0]}, humans ${who[1]} s, longest wait ${wait}, ${number(figure("arrivals"), 0)} arrived, ${number(figure("co2_kg"), 1, " kg CO2")}`);
  const least = tally.min_ttc_s == null ? "" : `, in all ${number(tally.min_ttc_s, 2)} s`;
  lines("ttc", figure("min_ttc_s") == null ? "> 10 s" : number(figure("min_ttc_s"), 2, " s"), `smallest in this episode${least}`);
}

// ---- sessions ----

function watch(found, seed) {
  if (socket) { socket.onclose = null; socket.close(); }
  session = found; road = null; wanted = true; explained = "";
  history.replaceState(null, "", `#session=${session.id}`);
  for (const id of ["again", "next", "on"]) $(id).disabled = session.program;
  socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/api/sessions/${session.id}/live`);
  socket.onopen = () => { if (seed !== undefined) send({ begin: seed }); };
  socket.onmessage = (event) => told(JSON.parse(event.data));
  socket.onclose = () => leave("The connection to the server is lost.");
}

// Nothing is watched any more; `why` is said where it is not the user's own wish.
function leave(why = "") {
  if (socket) { socket.onclose = null; socket.close(); }
  socket = null; session = null;
  if (player) { player.play(false); data.over = true; }
  history.replaceState(null, "", location.pathname);
  say(why, true); offer();
}

async function offer() {
  $("start").hidden = false; $("go").disabled = false; $("go").textContent = "Start";
  try {
    const open = await ask("/api/sessions"), list = $("others").querySelector("ul");
    $("others").hidden = !open.length; list.replaceChildren();
    for (const one of open) {
      const row = element("li"), button = element("button", "watch");
      button.onclick = () => watch(one, one.program || !one.over ? undefined : 200000);
      row.append(element("span", `${one.scenario} / ${one.demand}, ${one.request.policy || "idm"}`),
        element("small", `${one.program ? "driven by a program" : one.watched ? "watched" : "nobody watches"}, since ${one.created.slice(11, 19)} UTC`), button);
      list.append(row);
    }
  } catch (error) { $("wrong").textContent = error.message; }
}

function fillForm() {
  const form = $("scenario"), field = form.elements, worlds = catalogue.scenarios;
  choices(field.scenario, worlds.map((w) => w.name), "merge");
  choices(field.policy, catalogue.policies, "vfn-p");
  choices(field.behavior, [["", "the scenario's"], ...catalogue.behaviors]);
  choices(field.errors, [["", "none"], ...catalogue.errors]);
  choices(field.preset, [["", "the scenario's"], ...catalogue.presets]);
  const world = () => {
    const found = worlds.find((w) => w.name === field.scenario.value);
    choices(field.demand, found.demands, "contested");
    $("about").textContent = `${found.title}; ${found.duration_s.toFixed(0)} s an episode`;
  };
  field.scenario.onchange = world; world();
  form.onsubmit = async (event) => {
    event.preventDefault(); $("wrong").textContent = ""; $("go").disabled = true; $("go").textContent = "starting ...";
    const words = { maps: false, idle_s: 120 };
    for (const name of ["scenario", "demand", "policy", "behavior", "errors", "preset"]) if (field[name].value) words[name] = field[name].value;
    for (const name of ["svo", "penetration", "duration"]) if (field[name].value !== "") words[name] = Number(field[name].value);
    try {
      const old = session && !session.program ? session.id : null;
      const found = await ask("/api/sessions", words);
      watch(found, Number(field.seed.value));
      if (old) ask(`/api/sessions/${old}`, undefined, "DELETE").catch(() => {});
    } catch (error) { $("wrong").textContent = error.message; $("go").disabled = false; $("go").textContent = "Start"; }
  };
}

async function main() {
  document.documentElement.classList.toggle("dark", THEME.dark);
  $("to-live").setAttribute("aria-current", "page"); $("busy").hidden = true; $("title").textContent = "cosim";
  $("theme").onclick = () => { THEME.dark = !THEME.dark; };
  $("again").onclick = () => { wanted = true; send({ begin: data.facts.seed }); };
  $("next").onclick = () => { wanted = true; send({ next: true }); };
  $("why").onchange = (event) => { explains = event.target.checked; explain(); };
  $("other").onclick = () => { if ($("start").hidden) { if (player) player.play(false); offer(); $("go").focus(); } else if (session) $("start").hidden = true; };
  try {
    catalogue = await ask("/api/catalogue");
    fillForm();
    const id = new URLSearchParams(location.hash.slice(1)).get("session");
    const found = id && (await ask("/api/sessions")).find((one) => one.id === id);
    if (found) watch(found); else { await offer(); $("go").focus(); }
  } catch (error) { $("wrong").textContent = error.message; $("start").hidden = false; }
}

main();
