// Elements and figures as text: nothing that comes from elsewhere is ever read as HTML.

function element(tag, text, className) {
  const found = document.createElement(tag);
  if (text !== undefined) found.textContent = text;
  if (className) found.className = className;
  return found;
}

function number(value, digits, unit = "") {
  return value === null || value === undefined ? "\u2013" : `${value.toFixed(digits)}${unit}`;
}
