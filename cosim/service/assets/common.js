// What all pages need: the API, the theme, links.

const $ = (id) => document.getElementById(id);

// The document that the server answers with. Throws an Error with its sentence; without a token, goes to the form.
async function ask(path, body, method = body === undefined ? "GET" : "POST") {
  let answer;
  try {
    answer = await fetch(path, {
      method, body: body === undefined ? undefined : JSON.stringify(body),
      headers: body === undefined ? {} : { "Content-Type": "application/json" },
    });
  } catch { throw new Error("the server does not answer"); }
  if (answer.status === 401) { location.assign("/login"); throw new Error("a token is needed"); }
  const text = await answer.text();
  let found = null;
  try { found = text ? JSON.parse(text) : null; } catch { /* no document */ }
  if (answer.ok) return found;
  const { problem, field, value } = found || { problem: `HTTP ${answer.status}` };
  throw new Error((field ? `${field}${value == null ? "" : ` ${value}`}: ` : "") + problem);
}

const THEME = {
  system: matchMedia("(prefers-color-scheme: dark)"),
  get dark() { return (localStorage.getItem("theme") || (this.system.matches ? "dark" : "light")) === "dark"; },
  set dark(on) {
    document.documentElement.classList.toggle("dark", on);
    if (on === this.system.matches) localStorage.removeItem("theme"); else localStorage.setItem("theme", on ? "dark" : "light");
  },
};

function choices(select, values, chosen) {
  select.replaceChildren(...values.map((value) => (Array.isArray(value) ? new Option(value[1], value[0]) : new Option(value, value))));
  if (chosen !== undefined && values.flat().includes(chosen)) select.value = chosen;
}

// "0 of 12: 0.0 % (0.0 to 24.2)"
function shareText(found) {
  const percent = (x) => (100 * x).toFixed(1);
  return found ? `${found.hits} of ${found.n}: ${percent(found.value)} % (${percent(found.low)} to ${percent(found.high)})` : "\u2013";
}
