// Begins with the data that the file holds.

unpack(document.getElementById("data").textContent.trim()).then(start).catch((error) => {
  document.getElementById("busy").textContent = `This page could not be drawn: ${error.message}`;
});
