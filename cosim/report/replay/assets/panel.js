// The panel at the side: who the chosen vehicle is, what it decided and why, its speed over time.

function describe(vehicle) {
  const who = vehicle.av ? "autonomous (AV)" : vehicle.person ? "" : `human, ${vehicle.driver}`;
  return [who, vehicle.actor ? vehicle.what : "", vehicle.mission ? "mission vehicle" : ""].filter(Boolean).join(", ");
}

function link(state, id) { // a vehicle's name to click on, or plain words such as "[lane end]"
  const other = state.data.byId.get(id);
  if (!other) return document.createTextNode(id || "");
  const found = element("a", id);
  found.onclick = () => state.choose(other);
  return found;
}

function paragraph(state, ...parts) {
  const found = element("p");
  for (const part of parts) found.append(part instanceof Node ? part : document.createTextNode(part));
  return found;
}

function fillDetails(state) {
  const { data, chosen, t } = state, box = document.getElementById("details");
  box.replaceChildren();
  if (!chosen) { box.append(element("p", "Click a vehicle, or choose one above.", "quiet")); return; }
  box.append(element("p", describe(chosen)));
  const s = stateOf(data, chosen, t);
  if (!s) { box.append(element("p", "not on the road now", "quiet")); return; }
  const lane = s.lane >= 0 ? data.lanes[s.lane].id : "off every lane";
  box.append(element("p", `${s.speed.toFixed(1)} m/s (${(3.6 * s.speed).toFixed(0)} km/h), ` +
    `${s.accel.toFixed(1)} m/s\u00b2, lane ${lane}`));
  const error = erring(chosen, t), was = lastOf(chosen.errors, t, Infinity);
  if (error || was) {
    const one = error || was;
    box.append(element("p", `${error ? "" : "last error: "}${one.kind} ${one.t > 0 ? `at ${one.t.toFixed(1)} s` : "from the warm-up"}: it ${one.text}`, error ? "error" : "quiet"));
  }
  if (!chosen.av) return;
  const choice = choiceOf(data, chosen, t);
  const last = lastOf(chosen.corrections, t, Infinity), corrected = lastOf(chosen.corrections, t);
  const broken = lastOf(chosen.violations, t, Infinity);
  if (last) box.append(element("p", `${corrected ? "" : "last "}corrected by the car at ${last.t.toFixed(1)} s: ${last.text}`, corrected ? "correction" : "quiet"));
  if (broken) box.append(element("p", `${broken.text} at ${broken.t.toFixed(1)} s`, "law"));
  if (choice) fillChoice(state, box, choice, corrected);
  else box.append(element("p", "not commanded: SUMO's IDM drives", "quiet"));
}

function fillChoice(state, box, choice, corrected) {
  box.append(paragraph(state, `decided at ${choice.t.toFixed(1)} s: `, element("b", ACTIONS[choice.action]),
    `, target ${choice.target.toFixed(1)} m/s`));
  if (choice.fallback) box.append(element("p", "no action was safe: the one with the highest safety score", "bad"));
  if (choice.vetoed) {
    const line = paragraph(state, `${preferred(choice)} vetoed; blamed: `, link(state, choice.blamed));
    line.className = "warn"; box.append(line);
  }
  if (choice.blocked) box.append(element("p", `command blocked: ${choice.blocked}`, "bad"));
  else if (!corrected) box.append(element("p", "command executed", "quiet"));
  if (!choice.q && !choice.score) return;
  const table = element("table"), head = element("tr");
  for (const name of ["action", "Q", "score s", "TTC s", ""]) head.append(element("th", name));
  table.append(head);
  const tops = best(choice);
  ACTIONS.forEach((name, a) => {
    const row = element("tr");
    const unsafe = choice.unsafe && choice.unsafe[a];
    row.className = `${a === choice.action ? "chosen" : ""} ${unsafe ? "unsafe" : ""}`;
    row.append(element("td", name), element("td", choice.q ? number(choice.q[a], 3) : ""),
      element("td", choice.score ? number(choice.score[a], 2) : ""), element("td", choice.ttc ? number(choice.ttc[a], 1) : ""),
      element("td", [unsafe ? "unsafe" : "", tops.includes(a) && tops.length < ACTIONS.length ? "best Q" : ""].filter(Boolean).join(", ")));
    table.append(row);
  });
  box.append(table);
  if (choice.uses) fillUses(box, choice);
}

// What the choice hangs on: what it becomes when the network is asked again with one input replaced.
function fillUses(box, choice) {
  const table = element("table"), head = element("tr");
  for (const name of ["without", "replaced by", "choice", "|\u0394Q|"]) head.append(element("th", name));
  table.append(head);
  for (const [input, how, action, dq] of [...choice.uses].sort((a, b) => b[3] - a[3])) {
    const row = element("tr", undefined, action === choice.action ? "" : "changed");
    row.append(element("td", input), element("td", how), element("td", action === choice.action ? "same" : ACTIONS[action]), element("td", number(dq, 3)));
    table.append(row);
  }
  box.append(element("p", "What the choice hangs on:", "quiet"), table);
}

// Speed and target over the whole episode, the actions beneath; a click jumps there.
function drawChart(canvas, state) {
  const { data, chosen, c } = state, small = state.chart, ctx = canvas.getContext("2d");
  small.inPixels(ctx); ctx.clearRect(0, 0, small.width, small.height);
  if (!chosen) return;
  const left = 26, bottom = small.height - 20, wide = small.width - left - 4;
  const top = Math.max(10, ...chosen.tracks.map((k) => Math.max(...k.speed)), ...chosen.choices.map((k) => k.target));
  const px = (t) => left + (t / spanOf(data)) * wide, py = (v) => bottom - (v / top) * (bottom - 8);
  ctx.font = "10px system-ui, sans-serif"; ctx.fillStyle = c.quiet; ctx.textAlign = "right"; ctx.textBaseline = "middle";
  ctx.strokeStyle = c.line; ctx.lineWidth = 1;
  for (const v of [0, top / 2, top]) {
    ctx.fillText(v.toFixed(0), left - 4, py(v));
    ctx.beginPath(); ctx.moveTo(left, py(v)); ctx.lineTo(left + wide, py(v)); ctx.stroke();
  }
  ctx.save(); ctx.textAlign = "left"; ctx.fillText("m/s", 0, bottom + 10); ctx.restore();
  ctx.strokeStyle = colourOf(chosen, c); ctx.lineWidth = 1.6;
  for (const track of chosen.tracks) {
    ctx.beginPath();
    track.speed.forEach((v, i) => ctx.lineTo(px(data.times[track.first + i]), py(v)));
    ctx.stroke();
  }
  const hold = data.decided.length > 1 ? data.decided[1] - data.decided[0] : 0.4;
  const shades = { 0: c.aggressive, 2: c.moderate, 3: c.good, 4: c.bad };
  for (const choice of chosen.choices) {
    ctx.strokeStyle = c.quiet; ctx.beginPath();
    ctx.moveTo(px(choice.t), py(choice.target)); ctx.lineTo(px(choice.t + hold), py(choice.target)); ctx.stroke();
    if (choice.action !== 1) {
      ctx.fillStyle = shades[choice.action];
      ctx.fillRect(px(choice.t), bottom + 4, Math.max(px(hold) - px(0), 1.5), 6);
    }
    if (choice.vetoed) { ctx.fillStyle = choice.fallback ? c.bad : c.warn; ctx.fillRect(px(choice.t), bottom + 13, Math.max(px(hold) - px(0), 1.5), 4); }
  }
  ctx.fillStyle = c.correction;
  for (const one of chosen.corrections) ctx.fillRect(px(one.t) - 1, bottom + 13, 2, 6);
  ctx.strokeStyle = c.pick; ctx.lineWidth = 1;
  ctx.beginPath(); ctx.moveTo(px(state.t), 2); ctx.lineTo(px(state.t), bottom + 18); ctx.stroke();
}

function fillLegend(state) {
  const { data, c } = state, box = document.getElementById("legend");
  box.replaceChildren();
  const entry = (text, draw) => {
    const canvas = element("canvas"), ratio = window.devicePixelRatio || 1;
    canvas.width = 30 * ratio; canvas.height = 16 * ratio;
    const ctx = canvas.getContext("2d");
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    draw(ctx);
    box.append(canvas, element("span", text));
  };
  const shape = (actor, colour, [length, width], av) => (ctx) => {
    ctx.translate(15, 8); ctx.strokeStyle = c.ground; ctx.lineWidth = 0.5;
    drawShape(ctx, data.shapes.get(actor).parts, length, width, colour, c);
    if (av) { ctx.fillStyle = c.halo; ctx.beginPath(); ctx.arc(-4, 0, 2, 0, 7); ctx.fill(); }
  };
  const first = Math.min(...data.shapes.keys()); // a car, where there is one
  const car = (colour, av) => shape(first, colour, [24, 10], av);
  if (data.vehicles.some((v) => v.mission)) entry("mission vehicle", car(c.mission));
  if (data.vehicles.some((v) => v.av)) entry("AV", car(c.av, true));
  if (data.vehicles.some((v) => v.choices.length)) {
    const command = (...actions) => (ctx) => { ctx.translate(8, 8); for (const a of actions) { drawCommand(ctx, a, 14, c.av, c); ctx.translate(14, 0); } };
    entry("its command: accelerate, decelerate", command(3, 4));
    entry("its command: lane left, lane right", command(0, 2));
  }
  const classes = new Set(data.vehicles.filter((v) => !v.av && !v.person).map((v) => v.driver));
  for (const name of ["conservative", "moderate", "aggressive", "as-is"]) {
    if (classes.has(name)) entry(`human, ${name}`, car(name === "as-is" ? c.asis : c[name]));
  }
  const sizes = { 3: [22, 9], 4: [20, 9], 5: [10, 13] }; // pixels, of those that are small
  for (const [actor, { name }] of data.shapes) {
    if (actor && data.vehicles.some((v) => v.actor === actor)) entry(name, shape(actor, actor === 5 ? c.person : c.asis, sizes[actor] || [28, 10]));
  }
  const ring = (colour) => (ctx) => {
    ctx.strokeStyle = colour; ctx.lineWidth = 2; ctx.beginPath(); ctx.arc(10, 8, 6, 0, 7); ctx.stroke();
    ctx.setLineDash([3, 2]); ctx.beginPath(); ctx.moveTo(10, 8); ctx.lineTo(29, 8); ctx.stroke();
  };
  if (data.vehicles.some((v) => v.choices.some((k) => k.vetoed))) entry("preferred action vetoed; line to the vehicle that made it unsafe", ring(c.warn));
  if (data.vehicles.some((v) => v.choices.some((k) => k.fallback))) entry("no action was safe", ring(c.bad));
  if (data.forecasts.some(Boolean)) {
    entry(`predicted path, every second \u00b1${SIGMAS} standard deviations`, (ctx) => {
      ctx.strokeStyle = ctx.fillStyle = c.av; ctx.beginPath(); ctx.moveTo(0, 8); ctx.lineTo(30, 8); ctx.stroke();
      ctx.globalAlpha = 0.3; ctx.beginPath(); ctx.ellipse(20, 8, 9, 5, 0, 0, 7); ctx.fill();
    });
  }
  if (data.beliefs.some(Boolean)) {
    entry("where the chosen AV takes a vehicle to be, from which source, how old", (ctx) => {
      ctx.strokeStyle = c.pick; ctx.lineWidth = 1.5; ctx.setLineDash([4, 3]); ctx.strokeRect(4, 3, 22, 10); ctx.setLineDash([]);
    });
    entry("the chosen AV does not know of it: hidden, missed", (ctx) => {
      ctx.strokeStyle = c.bad; ctx.lineWidth = 2; ctx.beginPath(); ctx.moveTo(10, 3); ctx.lineTo(20, 13); ctx.moveTo(10, 13); ctx.lineTo(20, 3); ctx.stroke();
    });
  }
  if (data.errors.length) entry("human error; line to the first vehicle it affects", (ctx) => {
    ctx.strokeStyle = c.error; ctx.lineWidth = 1.5; ctx.setLineDash([2, 3]); ctx.beginPath(); ctx.moveTo(10, 8); ctx.lineTo(29, 8); ctx.stroke(); ctx.setLineDash([]);
    triangle(ctx, 10, 8, 7, c);
  });
  if (data.corrections.length) {
    entry("corrected by its car", (ctx) => { ctx.strokeStyle = c.correction; ctx.lineWidth = 2; ctx.strokeRect(9, 2, 12, 12); });
  }
  const line = (rule, ...states) => (ctx) => {
    ctx.translate(17, 8); ctx.scale(4, 4); ctx.strokeStyle = c.dark; ctx.lineWidth = 0.2;
    ctx.fillStyle = c.road; ctx.fillRect(-5, -2, 9, 4);
    drawStopLine(ctx, rule, states.map((state) => data.lamps[state]), 1.8, c, true);
  };
  const has = (test) => data.stopLines.some(test), bare = (rules) => has((s) => !s.signals.length && rules.includes(s.rule));
  if (has((s) => s.signals.length)) {
    entry("signals, one for each turn, the left one first (pale green: gives way; brown, grey: off)", line(0, "r", "y", "G"));
  }
  if (bare(STOPS)) entry("stop sign", line(STOPS[0]));
  if (bare([YIELD])) entry("give way", line(YIELD));
  if (data.crossings.length) entry("pedestrian crossing", (ctx) => {
    ctx.fillStyle = c.road; ctx.fillRect(0, 0, 30, 16); ctx.fillStyle = c.mark;
    for (let x = 2; x < 30; x += 6) ctx.fillRect(x, 1, 3, 14);
  });
  if (data.collisions.length) entry("collision", (ctx) => {
    ctx.strokeStyle = c.bad; ctx.lineWidth = 2; ctx.beginPath(); ctx.arc(15, 8, 6, 0, 7);
    ctx.moveTo(11, 4); ctx.lineTo(19, 12); ctx.moveTo(11, 12); ctx.lineTo(19, 4); ctx.stroke();
  });
  const patch = (colour) => (ctx) => { ctx.fillStyle = colour; ctx.fillRect(2, 4, 26, 8); };
  if (data.zones.size) entry("conflict zone", patch(c.zone));
  if (data.goal.size) entry("lanes where the mission is fulfilled", patch(c.goal));
}

// A button for each kind of events there is: shown or not, in the list, on the time line and for the keys.
function fillKinds(state) {
  const box = document.getElementById("kinds");
  box.replaceChildren();
  for (const [kind, [name, colour]] of Object.entries(EVENTS)) {
    const count = state.events.filter((e) => e.kind === kind).length;
    if (!count) continue;
    const shown = !state.hidden.has(kind), button = element("button", `${name} ${count}`, shown ? "on" : "");
    button.style.setProperty("--own", `var(--${colour})`);
    button.setAttribute("aria-pressed", String(shown));
    button.onclick = () => {
      if (!state.hidden.delete(kind)) state.hidden.add(kind);
      const on = !state.hidden.has(kind);
      button.classList.toggle("on", on); button.setAttribute("aria-pressed", String(on));
      fillEvents(state); state.seek(state.t);
    };
    box.append(button);
  }
}

// Events of the kinds that are shown; of the chosen vehicle only where that is asked for.
function wantedEvents(state) {
  const mine = document.getElementById("mine").checked && state.chosen;
  return state.events.filter((e) => !state.hidden.has(e.kind) && (!mine || e.who.includes(state.chosen.id)));
}

function fillEvents(state) {
  const list = document.getElementById("events"), wanted = wantedEvents(state), most = 400;
  list.replaceChildren(); state.listed = wanted.slice(0, most); state.now = -1;
  for (const event of wanted.slice(0, most)) {
    const row = element("li");
    row.append(element("time", `${event.t.toFixed(1)} s`), element("span", event.text, EVENTS[event.kind][1]));
    row.onclick = () => {
      const who = event.who.map((id) => state.data.byId.get(id)).find((v) => v && v.av) || state.data.byId.get(event.who[0]);
      if (who) state.choose(who, true);
      state.seek(event.t);
    };
    list.append(row);
  }
  if (wanted.length > most) list.append(element("li", `and ${wanted.length - most} more`, "quiet"));
  if (!wanted.length) list.append(element("li", "none", "quiet"));
  document.getElementById("count").textContent = `(${wanted.length})`;
}

// The last event that has begun is marked in the list, which follows it unless the pointer is on it.
function markEvent(state) {
  const list = document.getElementById("events"), now = atOrBefore(state.listed.map((e) => e.t), state.t + 0.05);
  if (now === state.now) return;
  list.children[state.now]?.classList.remove("now"); state.now = now;
  const row = list.children[now];
  row?.classList.add("now");
  if (!list.matches(":hover")) list.scrollTop = row ? row.offsetTop - list.offsetTop - list.clientHeight / 2 : 0;
}

function fillFigures(data) {
  const table = document.getElementById("figures");
  table.replaceChildren();
  const shown = (v) => v === null ? "NA" : v === true ? "yes" : v === false ? "no" :
    Number.isInteger(v) ? String(v) : v.toPrecision(4);
  const rows = [...data.facts.metrics, ["seed", data.facts.seed, ""], ["svo", data.facts.svo_deg, "deg"]];
  for (const [name, value, unit] of rows) {
    const row = element("tr");
    row.append(element("td", name), element("td", `${shown(value)} ${unit === "bool" || value === null ? "" : unit}`));
    table.append(row);
  }
  if (!data.facts.trace_hash) return;
  const row = element("tr"), cell = element("td", `trace ${data.facts.trace_hash}`);
  cell.colSpan = 2; cell.style.overflowWrap = "anywhere"; row.append(cell); table.append(row);
}

function fillHead(data) {
  const f = data.facts, chips = document.getElementById("chips");
  chips.replaceChildren();
  document.getElementById("title").textContent = `${f.scenario} / ${f.demand} / ${f.policy}`;
  const chip = (text, kind = "") => chips.append(element("span", text, `chip ${kind}`));
  const figure = (name) => (f.metrics.find(([n]) => n === name) || [])[1];
  if (f.policy_label) chip(f.policy_label, "warn");
  chip(`seed ${f.seed}`); chip(f.preset); chip(`humans ${f.behavior}, ${f.driver_model}`); chip(`SVO ${f.svo_deg}\u00b0`);
  if (f.errors) chip(`human errors ${f.errors}`);
  if (f.sensing) chip(`sensing ${f.sensing}`);
  const crashes = figure("collisions"), among = figure("crashed") ? "" : ", none of an AV or the mission vehicle";
  const running = data.over === false; // only what has happened can be said
  if (crashes != null && (crashes || !running)) chip(crashes ? `${crashes} collision${crashes > 1 ? "s" : ""}${among}` : "no collision", figure("crashed") ? "bad" : crashes ? "warn" : "good");
  if (figure("mission_success") != null && (figure("mission_success") || !running)) chip(figure("mission_success") ? "mission fulfilled" : "mission not fulfilled", figure("mission_success") ? "good" : "bad");
  if (f.mission_vehicle) chip(`mission vehicle ${f.mission_vehicle}${f.mission_guessed ? ", guessed" : ""}`, f.mission_guessed ? "warn" : "");
  for (const reason of f.not_comparable_because || []) chip(reason, "warn");
}
