// The page of runs: submit, list, filter, follow, read, compare.

// Figures that are shown first, as reports have it, and what they are called.
const SHOWN = ["collision_rate", "av_caused_collision_rate", "mission_success_rate", "mission_time_s", "dt_mean_m", "dt_av_m", "dt_mission_m", "min_ttc_s", "hard_brakings_av", "veto_rate"];
const UNITS = { events: "", vehicles: "", bool: "" };
const STATUSES = ["queued", "running", "finished", "cancelled", "failed"];
const TONES = { finished: "good", failed: "bad", cancelled: "warn" };
const MOST = 300; // rows of episodes that are listed
const BUSY = 1000, QUIET = 5000; // ms between two looks

const state = { runs: [], chosen: null, shown: null, timer: null };

const listed = (value) => (Array.isArray(value) ? value : value == null ? [] : [value]);
const policiesOf = (run) => (listed(run.request.policy).length ? listed(run.request.policy) : ["idm"]);
const labelOf = (policy) => policy.split("=")[0];
const titleOf = (run) => run.name || `${listed(run.request.scenario).join(", ")} / ${listed(run.request.demand).join(", ") || "its own"}`;
const ended = (run) => !["queued", "running"].includes(run.status);

function seconds(s) { return s == null ? "" : s < 90 ? `${Math.ceil(s)} s` : s < 5400 ? `${Math.round(s / 60)} min` : `${(s / 3600).toFixed(1)} h`; }

function digits(value, width) { // as many as the interval's width deserves
  if (value == null) return "NA";
  const places = width > 0 ? Math.min(Math.max(1 - Math.floor(Math.log10(width)), 0), 4) : Number.isInteger(value) ? 0 : 2;
  return value.toFixed(places);
}

// "12.5 %" over "4.4 to 26.1, 3 of 24"
function interval(figure, unit, isShare, count = "", signed = false) {
  if (!figure || figure.value == null) return two("NA", "");
  const k = isShare ? 100 : 1, { value, low, high } = figure, width = low == null ? 0 : k * (high - low);
  const sign = signed && value > 0 ? "+" : "", name = isShare ? (signed ? "pp" : "%") : UNITS[unit] ?? unit;
  const range = low == null ? "" : `${digits(k * low, width)} to ${digits(k * high, width)}`;
  return two(`${sign}${digits(k * value, isShare && !width ? 10 : width)} ${name}`, [range, count].filter(Boolean).join(", "));
}

// ---- the list ----

async function look() {
  clearTimeout(state.timer);
  let busy = false;
  try {
    state.runs = (await ask("/api/runs?limit=1000")).runs;
    busy = state.runs.some((run) => !ended(run));
    fillList(); fillSides();
    const run = state.runs.find((one) => one.id === state.chosen);
    if (run) await show(run);
  } catch (error) { $("none").textContent = error.message; $("none").hidden = false; }
  state.timer = setTimeout(look, busy ? BUSY : QUIET);
}

function wantedRuns() {
  const text = $("find").value.trim().toLowerCase();
  return state.runs.filter((run) => (!text || `${titleOf(run)} ${run.id}`.toLowerCase().includes(text)) &&
    (!$("status").value || run.status === $("status").value) &&
    (!$("world").value || listed(run.request.scenario).includes($("world").value)) &&
    (!$("by").value || policiesOf(run).includes($("by").value)));
}

function fillList() {
  const wanted = wantedRuns(), list = $("list"), focused = list.contains(document.activeElement) && document.activeElement.dataset.run;
  list.replaceChildren();
  for (const run of wanted) {
    const row = element("li"), button = element("button", undefined, run.id === state.chosen ? "chosen" : "");
    button.dataset.run = run.id;
    const bar = element("progress"); bar.max = Math.max(run.episodes, 1); bar.value = run.done; bar.hidden = ended(run);
    const far = run.status === "running" ? `${run.done} of ${run.episodes}${run.seconds_left ? `, ${seconds(run.seconds_left)} left` : ""}` :
      run.status === "queued" ? `${run.waiting ?? 0} before it` : `${run.done} of ${run.episodes}`;
    button.append(element("b", titleOf(run)), element("span", run.status, `chip ${TONES[run.status] || ""}`),
      element("small", policiesOf(run).map(labelOf).join(", ")), element("small", `${far}, ${run.created.slice(0, 16).replace("T", " ")}`), bar);
    button.onclick = () => choose(run.id);
    row.append(button); list.append(row);
    if (focused === run.id) button.focus();
  }
  $("none").hidden = wanted.length > 0;
  $("none").textContent = state.runs.length ? "No run is like that." : "No run yet: submit one.";
}

function choose(id) {
  state.chosen = id; state.shown = null;
  history.replaceState(null, "", id ? `#run=${id}` : location.pathname);
  look();
}

// ---- one run ----

async function show(run) {
  const mark = `${run.status} ${run.done} ${run.waiting} ${run.error} ${JSON.stringify(run.running)}`;
  if (state.shown === mark) return;
  const box = element("div"), head = element("div", undefined, "row");
  head.append(element("h2", titleOf(run)), element("span", run.status, `chip ${TONES[run.status] || ""}`));
  const links = element("div", undefined, "bar");
  const act = (text, work, className) => { const b = element("button", text, className); b.onclick = () => work().catch(fail); links.append(b); };
  const open = (text, path) => { const a = element("a", text); a.href = path; a.target = "_blank"; a.rel = "noopener"; links.append(a); };
  if (run.status === "finished") {
    open("report", `/api/runs/${run.id}/report`); open("episodes.csv", `/api/runs/${run.id}/files/episodes.csv`); open("summary.json", `/api/runs/${run.id}/summary`);
  }
  if (!ended(run)) act("cancel", async () => { await ask(`/api/runs/${run.id}/cancel`, {}); await look(); });
  else {
    if (run.status !== "finished") act("resume", async () => { await ask(`/api/runs/${run.id}/resume`, {}); await look(); });
    act("forget", async () => { if (confirm(`Forget "${titleOf(run)}" and its files?`)) { await ask(`/api/runs/${run.id}`, undefined, "DELETE"); choose(null); $("one").replaceChildren(); } });
  }
  const words = Object.entries(run.request).map(([name, value]) => `${name} ${listed(value).join(", ")}`).join("; ");
  box.append(head, element("p", `${words}; ${run.done} of ${run.episodes} episodes`, "quiet"), links);
  if (run.error) box.append(element("p", run.error, "bad"));
  for (const one of run.running) {
    const bar = element("progress"), line = element("label", `${one.episode} `, "far");
    bar.max = one.of_s || 1; bar.value = one.simulated_s; line.append(bar); box.append(line);
  }
  const rows = (await ask(`/api/runs/${run.id}/rows?limit=${MOST}`));
  if (run.status === "finished") box.append(element("h3", "Figures"), await figures(run));
  if (rows.total) box.append(element("h3", "Episodes"), episodes(run, rows));
  if (state.chosen !== run.id) return; // chosen otherwise meanwhile
  state.shown = mark;
  $("one").replaceChildren(box);
}

function fail(error) { $("one").prepend(element("p", error.message, "bad")); }

function tableOf(heads, rows) {
  const table = element("table"), scroll = element("div", undefined, "scroll"), top = element("tr");
  for (const head of heads) top.append(element("th", head));
  table.append(top);
  for (const cells of rows) {
    const row = element("tr");
    for (const cell of cells) { const td = element("td"); td.append(cell); row.append(td); }
    table.append(row);
  }
  scroll.tabIndex = 0; scroll.append(table);
  return scroll;
}

const two = (first, second) => { const found = element("span", first); found.append(element("small", second)); return found; };

async function figures(run) {
  const { groups } = await ask(`/api/runs/${run.id}/summary`);
  const varied = ["scenario", "demand", "behavior", "penetration", "preset", "errors", "svo_deg"].filter((name) => new Set(groups.map((g) => g[name])).size > 1);
  const has = (name) => groups.some((g) => (g.rates[name] || g.means[name] || {}).n);
  const names = SHOWN.filter(has);
  const cell = (group, name) => {
    const rate = group.rates[name], mean = group.means[name];
    if (rate) return interval(rate, "", true, rate.n ? `${rate.hits} of ${rate.n}` : "");
    return interval(mean, mean?.unit, mean?.unit === "share", mean && `n ${mean.n}`);
  };
  return tableOf(["policy", ...names.map(called)], groups.map((group) => [
    two(group.policy, varied.map((name) => `${name} ${group[name]}`).join(", ")), ...names.map((name) => cell(group, name))]));
}

const called = (name) => ({ collision_rate: "C%", av_caused_collision_rate: "C% by AVs", mission_success_rate: "missions", dt_mean_m: "DT", dt_av_m: "DT of AVs", dt_mission_m: "DT of mission", min_ttc_s: "TTC" }[name] || name.replace(/_(s|m)$/, "").replaceAll("_", " "));

function episodes(run, { total, rows }) {
  const yes = (value) => (value === true ? "yes" : value === false ? "no" : "NA");
  const sorted = [...rows].sort((x, y) => Number(y.crashed ?? 0) - Number(x.crashed ?? 0));
  const found = element("div");
  found.append(tableOf(["policy", "seed", "crash", "mission", "DT m", "TTC s", ""], sorted.map((row) => {
    const link = element("a", "replay");
    link.href = `/api/runs/${run.id}/replay?episode=${encodeURIComponent(row.key)}`; link.target = "_blank"; link.rel = "noopener";
    const replays = row.status === "ok" && run.status === "finished";
    return [two(row.policy, [row.scenario, row.demand].join(" / ")), String(row.seed), row.status === "ok" ? yes(row.crashed) : row.status, yes(row.mission_success),
      number(row.dt_mean_m, 0), number(row.min_ttc_s, 2), replays ? link : ""];
  })));
  if (total > rows.length) found.append(element("p", `the first ${rows.length} of ${total}; all are in episodes.csv`, "quiet"));
  return found;
}

// ---- two of them ----

function fillSides() {
  const sides = state.runs.filter((run) => run.status === "finished").flatMap((run) => policiesOf(run).map(labelOf).map((policy) => [`${run.id}:${policy}`, `${policy}: ${titleOf(run)} (${run.id.slice(0, 4)})`]));
  const mark = JSON.stringify(sides);
  if (fillSides.before === mark) return;
  fillSides.before = mark;
  [$("a"), $("b")].forEach((select, k) => {
    const kept = select.value;
    choices(select, sides, kept || (sides[k] || sides[0] || [])[0]);
  });
  $("set-against").disabled = !sides.length;
}

async function compare() {
  const box = $("verdict");
  box.replaceChildren(element("p", "comparing ...", "quiet"));
  let found;
  try { found = await ask(`/api/compare?${new URLSearchParams({ a: $("a").value, b: $("b").value })}`); } catch (error) { box.replaceChildren(element("p", error.message, "bad")); return; }
  box.replaceChildren();
  for (const group of found.groups) {
    const all = Object.entries(group.figures).filter(([, figure]) => figure.n);
    const names = $("all").checked ? all : all.filter(([name]) => SHOWN.includes(name));
    box.append(element("h3", group.name), element("p", `${group.pairs} pairs${group.identical ? `, ${group.identical} drove exactly alike` : ""}${group.not_comparable ? `, ${group.not_comparable} say that they are not comparable` : ""}`, "quiet"));
    box.append(tableOf(["figure", "A", "B", "B \u2212 A"], names.map(([name, figure]) => {
      const rate = figure.hits_a !== undefined, unit = figure.unit || "";
      const share = rate || unit === "share", clear = figure.difference.low > 0 || figure.difference.high < 0;
      const better = clear && figure.better && (figure.difference.value > 0) === (figure.better === "higher");
      const difference = interval(figure.difference, unit, share, figure.p == null ? "" : `p ${figure.p.toFixed(3)}`, true);
      if (clear && figure.better) difference.className = better ? "good" : "bad";
      return [called(name), interval(figure.a, unit, share, rate ? `${figure.hits_a} of ${figure.n}` : `n ${figure.n}`),
        interval(figure.b, unit, share, rate ? `${figure.hits_b} of ${figure.n}` : `n ${figure.n}`), difference];
    })));
  }
  if (!found.groups.length) box.append(element("p", "The two share no seed of the same traffic.", "warn"));
  if (found.groups.length) box.append(element("p", "Paired on equal seeds, 95 % intervals; coloured where the difference's interval leaves 0 out.", "quiet"));
}

// ---- a new one ----

function requestOf(form) {
  const field = form.elements, first = Number(field.first.value), found = { seeds: `${first}:${first + Number(field.count.value)}` };
  for (const name of ["name", "scenario", "demand", "behavior", "errors"]) if (field[name].value) found[name] = field[name].value;
  for (const name of ["svo", "duration"]) if (field[name].value !== "") found[name] = Number(field[name].value);
  found.policy = [...field.policy.selectedOptions].map((option) => option.value);
  return found;
}

function fillForm(catalogue) {
  const form = $("run"), field = form.elements;
  choices(field.scenario, catalogue.scenarios.map((w) => w.name), "merge");
  choices(field.policy, catalogue.policies);
  for (const option of field.policy.options) option.selected = ["idm", "vfn-p"].includes(option.value);
  choices(field.behavior, [["", "the scenario's"], ...catalogue.behaviors]);
  choices(field.errors, [["", "none"], ...catalogue.errors]);
  const world = () => choices(field.demand, catalogue.scenarios.find((w) => w.name === field.scenario.value).demands, "contested");
  field.scenario.onchange = world; world();
  const tried = async (work) => { $("wrong").textContent = ""; try { await work(); } catch (error) { $("wrong").textContent = error.message; } };
  form.onsubmit = (event) => {
    event.preventDefault();
    tried(async () => { const run = await ask("/api/runs", requestOf(form)); form.hidden = true; choose(run.id); });
  };
  $("estimate").onclick = () => tried(async () => {
    $("long").textContent = "driving a few episodes ...";
    try { const found = await ask("/api/estimates", requestOf(form)); $("long").textContent = `${found.episodes} episodes, about ${seconds(found.estimated_s) || "?"}`; } catch (error) { $("long").textContent = ""; throw error; }
  });
  choices($("status"), [["", "any status"], ...STATUSES]);
  choices($("world"), [["", "any scenario"], ...catalogue.scenarios.map((w) => w.name)]);
  choices($("by"), [["", "any policy"], ...catalogue.policies]);
}

// ---- keys ----

function neighbour(direction) {
  const runs = wantedRuns(), here = runs.findIndex((run) => run.id === state.chosen);
  const next = runs[Math.min(Math.max(here + direction, 0), runs.length - 1)];
  if (next) choose(next.id);
}

const KEYS = [["j k", "next, previous run"], ["/", "filter"], ["a", "submit a run"], ["c", "compare"], ["r", "the chosen run's report"], ["t", "dark or light"], ["esc", "close"], ["?", "these keys"]];
const ACTS = {
  j: () => neighbour(1), k: () => neighbour(-1), "/": () => $("find").focus(), a: () => $("add").click(), c: () => $("a").focus(), t: () => $("theme").click(),
  r: () => { const link = $("one").querySelector("a"); if (link) link.click(); }, "?": () => $("help").click(), Escape: () => { $("run").hidden = true; },
};

async function main() {
  document.documentElement.classList.toggle("dark", THEME.dark);
  $("to-runs").setAttribute("aria-current", "page");
  const table = element("table");
  for (const [key, what] of KEYS) {
    const row = element("tr"), cell = element("td");
    for (const one of key.split(" ")) cell.append(element("kbd", one), " ");
    row.append(cell, element("td", what)); table.append(row);
  }
  $("keys").append(table); $("keys").onclick = () => $("keys").close();
  $("help").onclick = () => ($("keys").open ? $("keys").close() : $("keys").showModal());
  $("theme").onclick = () => { THEME.dark = !THEME.dark; };
  $("add").onclick = () => { $("run").hidden = !$("run").hidden; if (!$("run").hidden) $("run").elements.name.focus(); };
  for (const id of ["find", "status", "world", "by"]) $(id).oninput = fillList;
  $("set-against").onclick = compare;
  $("all").onchange = () => { if ($("verdict").children.length) compare(); };
  window.onkeydown = (e) => {
    if (e.ctrlKey || e.metaKey || e.altKey || $("keys").open || ["INPUT", "SELECT"].includes(e.target.tagName)) {
      if (e.key === "Escape" && e.target.blur) e.target.blur();
      return;
    }
    if (ACTS[e.key]) { e.preventDefault(); ACTS[e.key](); }
  };
  state.chosen = new URLSearchParams(location.hash.slice(1)).get("run");
  try { fillForm(await ask("/api/catalogue")); } catch (error) { $("none").textContent = error.message; $("none").hidden = false; }
  await look();
}

main();
