// Time, keys and pointer: what the user does, and one picture per animation frame.

const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4, 8];
const BESIDE = 100; // ms between two drawings of what stands beside the scene, while it plays
const ROW = 170; // m of road from left to right, at first
const DETAIL = 2.2; // pixels per m from which vehicles are more than boxes
const BIN = 4; // pixels of the time line that share a bar
const KEYS = [["space", "play, pause"], ["\u2190 \u2192", "one frame (shift: 2 s)"], ["home end", "first, last moment"],
  ["[ ]", "event before, after"], ["< >", "slower, faster"], ["+ \u2212", "zoom (or the wheel)"], ["0", "the whole net"],
  ["f", "follow the chosen vehicle"], ["m", "choose the mission vehicle"], ["n p", "next, previous vehicle in view"],
  ["g", "predictions"], ["l", "names"], ["t", "dark or light"], ["esc", "choose nobody"], ["?", "these keys"]];

// `live` watches an episode that is still driven: pace(state) s of it a s, pull(t) to be driven so far, ended() when the last
// moment is reached, dark(), darken(on) and keys [key, what, act] of its page. Returns load(data) for another episode, grown() for when it got longer.
function start(data, live = null) {
  const $$ = (id) => document.getElementById(id);
  const scene = $$("scene"), view = new View(scene), map = new View($$("map")), chart = new View($$("chart"));
  const timeline = new View($$("timeline"));
  const state = {
    data, view, map, chart, t: 0, playing: false, rate: 1, chosen: null, following: false, labels: false, hidden: new Set(),
    resting: false, // following, but the picture stands while it holds the chosen vehicle
    predictions: true, events: [], shown: [], c: null, dirty: true, live,
  };
  let net = null, flat = null, beside = 0; // box of the road, its corridor; // ms, when what stands beside the scene was last drawn

  state.choose = (vehicle, follow = state.following) => {
    state.chosen = vehicle; state.following = Boolean(vehicle) && follow; state.resting = false;
    $$("pick").value = vehicle ? vehicle.number : "";
    if ($$("mine").checked) fillEvents(state);
    touch();
  };
  state.seek = (t) => { state.t = Math.min(Math.max(t, data.times[0] || 0), data.end); touch(); };
  function touch() { state.dirty = true; }
  function play(on = !state.playing) {
    if (on && state.t >= data.end - 1e-6 && !goesOn()) state.t = data.times[0] || 0;
    state.playing = on; state.stepping = false; $$("play").textContent = on ? "pause" : "play"; touch();
  }
  function goesOn() { return live && !data.over; }
  function speed(rate) { state.rate = rate; $$("speed").value = rate; }
  function step(frames) {
    const k = atOrBefore(data.times, state.t), on = data.times[k] < state.t - 1e-6 && frames < 0 ? 1 : 0;
    play(false);
    if (goesOn() && k + frames >= data.times.length) { live.pull(data.end + 0.01); state.stepping = true; }
    state.seek(data.times[Math.min(Math.max(k + frames + on, 0), data.times.length - 1)]);
  }
  function theme(dark) { if (live) live.darken(dark); document.documentElement.classList.toggle("dark", dark); state.c = colours(); fillLegend(state); touch(); }
  function jump(direction) {
    const wanted = wantedEvents(state);
    const next = direction > 0 ? wanted.find((e) => e.t > state.t + 0.05) : wanted.filter((e) => e.t < state.t - 0.05).pop();
    if (next) state.seek(next.t);
  }
  function neighbour(direction) {
    const shown = state.shown.map(([v]) => v);
    if (!shown.length) return;
    const here = shown.indexOf(state.chosen);
    state.choose(shown[(here + direction + shown.length) % shown.length]);
  }
  function follow(on) { state.following = on && Boolean(state.chosen); state.resting = false; touch(); }
  function fit() { follow(false); view.fit(net); touch(); }

  function resize() {
    for (const v of [view, map, chart, timeline]) v.resize();
    map.fit(net); touch();
  }

  function picture(now) {
    if (state.playing) {
      state.t += ((now - (picture.before ?? now)) / 1000) * state.rate * (goesOn() ? live.pace(state) : 1);
      if (state.t >= data.end) { state.t = data.end; if (!goesOn()) { play(false); if (live) live.ended(); } }
      touch();
    }
    picture.before = now;
    if (state.dirty) {
      state.dirty = false;
      const s = state.following && state.chosen && stateOf(data, state.chosen, state.t);
      if (s && !(state.resting && view.holds(s))) { view.x = s.x; view.y = s.y; state.resting = false; }
      view.arrange(flat, net);
      drawScene(scene.getContext("2d"), state);
      if (!state.playing || now - beside > BESIDE) { // what changes slowly
        beside = now;
        drawMap($$("map"), state); drawChart($$("chart"), state); drawTimeline();
        fillDetails(state); markEvent(state);
      }
      $$("follow").classList.toggle("on", state.following);
      $$("clock").textContent = `${state.t.toFixed(1)} / ${spanOf(data).toFixed(1)} s`;
      $$("predictions").checked = state.predictions; $$("labels").checked = state.labels;
    }
    requestAnimationFrame(picture);
  }

  function timeBins(px) { // column of the time line -> the events that fall into it
    const bins = new Map();
    for (const e of wantedEvents(state)) {
      const bin = Math.floor(px(e.t) / BIN);
      if (bins.has(bin)) bins.get(bin).push(e); else bins.set(bin, [e]);
    }
    return bins;
  }

  function drawTimeline() {
    const ctx = $$("timeline").getContext("2d"), { c } = state, w = timeline.width, h = timeline.height;
    const px = (t) => 6 + (t / spanOf(data)) * (w - 12);
    timeline.inPixels(ctx); ctx.clearRect(0, 0, w, h);
    ctx.fillStyle = c.line; ctx.fillRect(6, h - 12, w - 12, 4);
    ctx.fillStyle = c.av; ctx.fillRect(6, h - 12, px(state.t) - 6, 4);
    const bins = timeBins(px), kinds = Object.keys(EVENTS);
    const most = Math.max(...[...bins.values()].map((found) => found.length), 3);
    for (const [bin, found] of bins) { // the gravest at the bottom; each kind is seen
      let top = h - 14;
      const room = (h - 16) * Math.max(Math.sqrt(found.length / most), 0.35), kindsHere = kinds.filter((kind) => found.some((e) => e.kind === kind));
      for (const kind of kindsHere) {
        const here = found.filter((e) => e.kind === kind), spare = Math.max(room - 3 * kindsHere.length, 0);
        const tall = 3 + (spare * here.length) / found.length;
        ctx.globalAlpha = kind === "collision" || kind === "law" || !state.chosen || here.some((e) => e.who.includes(state.chosen.id)) ? 1 : 0.4;
        ctx.fillStyle = c[EVENTS[kind][1]]; ctx.fillRect(bin * BIN, top - tall, BIN - 1, tall - 0.5);
        top -= tall;
      }
    }
    ctx.globalAlpha = 1; ctx.fillStyle = c.pick;
    if (goesOn()) ctx.fillRect(px(data.end) - 1, h - 16, 2, 12); // as far as it is driven
    ctx.beginPath(); ctx.arc(px(state.t), h - 10, 6, 0, 7); ctx.fill();
  }

  function nearest(event) {
    const box = scene.getBoundingClientRect();
    const [x, y] = view.toMetres(event.clientX - box.left, event.clientY - box.top);
    let best = null, reach = Math.max(4, 14 / view.scale);
    for (const [vehicle, s] of state.shown) {
      const d = Math.hypot(s.x - x, s.y - y);
      if (d < reach) { best = [vehicle, s]; reach = d; }
    }
    return best;
  }

  let drag = null;
  const fingers = new Map();
  scene.onpointerdown = (e) => {
    scene.setPointerCapture(e.pointerId); fingers.set(e.pointerId, [e.clientX, e.clientY]);
    drag = { x: e.clientX, y: e.clientY, moved: 0 };
  };
  scene.onpointermove = (e) => {
    if (drag && fingers.has(e.pointerId)) {
      if (fingers.size === 2) { // pinch
        const [a, b] = [...fingers.values()], before = Math.hypot(a[0] - b[0], a[1] - b[1]);
        fingers.set(e.pointerId, [e.clientX, e.clientY]);
        const [p, q] = [...fingers.values()];
        view.zoom(Math.hypot(p[0] - q[0], p[1] - q[1]) / Math.max(before, 1)); drag.moved = 99; touch(); return;
      }
      fingers.set(e.pointerId, [e.clientX, e.clientY]);
      drag.moved += Math.abs(e.clientX - drag.x) + Math.abs(e.clientY - drag.y);
      if (drag.moved > 4) { follow(false); view.pan(e.clientX - drag.x, -(e.clientY - drag.y)); scene.style.cursor = "grabbing"; touch(); }
      drag.x = e.clientX; drag.y = e.clientY; return;
    }
    const found = nearest(e), tip = $$("tip");
    tip.hidden = !found; scene.style.cursor = found ? "pointer" : "grab";
    if (found) {
      const [vehicle, s] = found, choice = vehicle.av && choiceOf(data, vehicle, state.t);
      tip.textContent = `${vehicle.id}\n${describe(vehicle)}\n${s.speed.toFixed(1)} m/s` + (choice ? `, ${ACTIONS[choice.action]}` : "");
      const box = scene.getBoundingClientRect();
      tip.style.left = `${Math.max(Math.min(e.clientX - box.left + 14, view.width - 210), 0)}px`; tip.style.top = `${e.clientY - box.top + 14}px`;
    }
  };
  scene.onpointerup = scene.onpointercancel = (e) => {
    fingers.delete(e.pointerId);
    if (drag && drag.moved <= 4 && e.type === "pointerup") {
      const found = nearest(e);
      if (found) state.choose(found[0], false); else state.choose(null);
    }
    if (!fingers.size) drag = null;
    scene.style.cursor = "grab";
  };
  scene.ondblclick = (e) => { const found = nearest(e); if (found) state.choose(found[0], true); };
  scene.onwheel = (e) => {
    e.preventDefault();
    const box = scene.getBoundingClientRect(), factor = Math.exp(-e.deltaY * (e.ctrlKey ? 0.01 : 0.0015));
    if (state.following) view.zoom(factor); else view.zoom(factor, e.clientX - box.left, e.clientY - box.top);
    touch();
  };
  const scrub = (canvas, at) => {
    canvas.onpointerdown = (e) => { canvas.setPointerCapture(e.pointerId); at(e); };
    canvas.onpointermove = (e) => { if (e.buttons) at(e); };
  };
  const inside = (canvas, e) => { const box = canvas.getBoundingClientRect(); return [e.clientX - box.left, e.clientY - box.top]; };
  scrub($$("timeline"), (e) => state.seek(((inside($$("timeline"), e)[0] - 6) / (timeline.width - 12)) * spanOf(data)));
  $$("timeline").addEventListener("pointermove", (e) => { // what happened beneath the pointer
    const px = (t) => 6 + (t / spanOf(data)) * (timeline.width - 12), bin = Math.floor(inside($$("timeline"), e)[0] / BIN);
    const bins = timeBins(px), near = [0, -1, 1].map((k) => bins.get(bin + k)).find(Boolean) || [];
    const lines = Object.entries(EVENTS).map(([kind, [name]]) => [name, near.filter((k) => k.kind === kind)]).filter(([, found]) => found.length);
    $$("timeline").title = lines.map(([name, found]) => (found.length > 3 ? `${found.length} ${name}` : found.map((k) => `${k.t.toFixed(1)} s ${k.text}`).join("\n"))).join("\n");
  });
  scrub($$("chart"), (e) => state.seek(((inside($$("chart"), e)[0] - 26) / (chart.width - 30)) * spanOf(data)));
  scrub($$("map"), (e) => { follow(false); [view.x, view.y] = map.toMetres(...inside($$("map"), e)); touch(); });

  $$("play").onclick = () => play(); $$("back").onclick = () => step(-1); $$("forth").onclick = () => step(1);
  $$("fit").onclick = fit; $$("follow").onclick = () => follow(!state.following);
  $$("theme").onclick = () => theme(!document.documentElement.classList.contains("dark"));
  $$("help").onclick = () => ($$("keys").open ? $$("keys").close() : $$("keys").showModal());
  $$("keys").onclick = () => $$("keys").close();
  $$("predictions").onchange = (e) => { state.predictions = e.target.checked; touch(); };
  $$("labels").onchange = (e) => { state.labels = e.target.checked; touch(); };
  $$("mine").onchange = () => fillEvents(state);
  $$("speed").onchange = (e) => speed(Number(e.target.value));
  $$("pick").onchange = (e) => { state.choose(e.target.value === "" ? null : data.vehicles[e.target.value], true); e.target.blur(); };

  const keys = {
    " ": () => play(), ArrowLeft: (e) => (e.shiftKey ? state.seek(state.t - 2) : step(-1)),
    ArrowRight: (e) => (e.shiftKey ? state.seek(state.t + 2) : step(1)), Home: () => state.seek(0), End: () => state.seek(data.end),
    "[": () => jump(-1), "]": () => jump(1), "+": () => { view.zoom(1.3); touch(); }, "=": () => { view.zoom(1.3); touch(); },
    "-": () => { view.zoom(1 / 1.3); touch(); }, 0: fit, f: () => follow(!state.following), n: () => neighbour(1), p: () => neighbour(-1),
    "<": () => speed(SPEEDS[Math.max(SPEEDS.indexOf(state.rate) - 1, 0)]), ">": () => speed(SPEEDS[Math.min(SPEEDS.indexOf(state.rate) + 1, SPEEDS.length - 1)]),
    ",": () => keys["<"](), ".": () => keys[">"](), g: () => { state.predictions = !state.predictions; touch(); },
    l: () => { state.labels = !state.labels; touch(); }, t: () => $$("theme").click(), m: () => { const v = data.vehicles.find((k) => k.mission); if (v) state.choose(v, true); },
    Escape: () => state.choose(null), "?": () => $$("help").click(),
  };
  window.onkeydown = (e) => {
    if (e.ctrlKey || e.metaKey || e.altKey || ["SELECT", "INPUT"].includes(e.target.tagName)) return;
    if (e.key === "Escape" && $$("keys").open) return; // closes the dialog
    const act = keys[e.key];
    if (act) { e.preventDefault(); act(e); }
  };

  function refresh() { // what hangs on who was there and what happened so far
    const before = state.events.length, wide = $$("pick").options.length - 1;
    state.events = eventsOf(data);
    if (wide !== data.vehicles.length && document.activeElement !== $$("pick")) {
      const order = [...data.vehicles].sort((a, b) => b.mission - a.mission || b.av - a.av || a.person - b.person || a.id.localeCompare(b.id, "en", { numeric: true }));
      $$("pick").replaceChildren(new Option("nobody", ""), ...order.map((v) => new Option(`${v.id} (${v.mission ? "mission" : v.av ? "AV" : v.person ? v.what : v.driver})`, v.number)));
      $$("pick").value = state.chosen ? state.chosen.number : "";
      fillLegend(state);
    }
    if (before !== state.events.length) { fillKinds(state); fillEvents(state); fillLegend(state); }
    $$("predictions").parentElement.hidden = !data.forecasts.some(Boolean);
  }

  function load(fresh) {
    const same = state.chosen && fresh.byId.get(state.chosen.id), following = state.following;
    data = state.data = fresh;
    state.chosen = null; state.stepping = false; state.events = []; state.t = live ? data.end : 0;
    net = bounds(data.lanes.length ? data.lanes : [{ box: [0, 0, 100, 100] }]);
    flat = corridor(data.lanes);
    $$("pick").replaceChildren();
    fillHead(data); fillFigures(data); fillKinds(state); fillEvents(state); refresh();
    const there = [...$$("pick").options].slice(1).map((option) => data.vehicles[option.value]);
    const soonest = [...there].sort((a, b) => b.mission - a.mission || b.av - a.av || a.tracks[0].first - b.tracks[0].first)[0];
    const first = same || there.find((v) => stateOf(data, v, state.t)) || soonest;
    if (first) state.choose(first, same ? following : true);
    return first;
  }

  function grown() {
    refresh();
    if (state.stepping) { state.stepping = false; step(1); }
    touch();
  }

  // The first picture: a flat road in rows; else the conflict zone and the way of the chosen vehicle until its mission is fulfilled.
  function open() {
    const track = first && first.tracks[0];
    if (!track) { view.fit(net); return; }
    const s = stateOf(data, first, state.t) || { x: track.x[0], y: track.y[0] };
    view.x = s.x; view.y = s.y; view.scale = Math.max(view.width / ROW, DETAIL);
    if (flat || live) return;
    const done = data.facts.metrics.find(([name]) => name === "mission_time_s"), until = (done && done[1]) ?? data.end;
    const last = Math.min(atOrBefore(data.times, until + 3), track.last) - track.first;
    const way = placed(track, Math.max(atOrBefore(data.times, 0) - track.first, 0), last), home = new View(scene);
    home.resize(); home.fit(bounds([...data.zones].map((k) => data.lanes[k]).concat(way)), 1.3);
    if (home.scale < DETAIL) return;
    view.x = home.x; view.y = home.y; view.scale = Math.min(home.scale, (2 * view.width) / ROW); state.resting = true;
  }

  for (const rate of SPEEDS) $$("speed").append(new Option(`${rate} \u00d7`, rate));
  speed(1);
  const table = element("table");
  for (const [key, what] of [...KEYS, ...(live ? live.keys : []).map(([key, what]) => [key, what])]) {
    const row = element("tr"), cell = element("td");
    for (const one of key.split(" ")) cell.append(element("kbd", one), " ");
    row.append(cell, element("td", what)); table.append(row);
  }
  for (const [key, , act] of live ? live.keys : []) keys[key] = act;
  $$("keys").append(table);
  $$("busy").hidden = true;
  theme(live ? live.dark() : matchMedia("(prefers-color-scheme: dark)").matches);
  const first = load(data);
  new ResizeObserver(resize).observe($$("stage"));
  resize();
  open();
  const asked = new URLSearchParams(location.hash.slice(1)); // replay.html#t=12.4&v=av.3&zoom=8
  if (data.byId.has(asked.get("v"))) state.choose(data.byId.get(asked.get("v")), true);
  if (asked.has("zoom")) view.scale = Number(asked.get("zoom")) || view.scale;
  if (asked.has("t")) state.seek(Number(asked.get("t")) || 0);
  window.replay = state; // for whoever looks at it from the console, and for tests
  requestAnimationFrame(picture);
  return { state, load, grown, play, fit };
}
