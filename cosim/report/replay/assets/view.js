// The camera: world metres (y up) to pixels and back, zoom about a point, follow a vehicle. A flat road is shown in rows that
// continue one another, as lines of text do.

const MOST_ROWS = 4, VERGE = 20; // m of a row beside the road

class View {
  constructor(canvas) {
    this.canvas = canvas;
    this.x = 0; this.y = 0; // m, the middle of the picture
    this.scale = 5; // pixels per m
    this.width = this.height = 1;
    this.rows = 1; this.row = 0; this.strip = 0; // how many; the one that is drawn; y of those that are not `main`
  }

  get main() { return this.rows >> 1; }
  get high() { return this.height / this.rows; } // pixels of a row
  get left() { return this.x + ((this.row - this.main) * this.width) / this.scale; } // m, the middle of the row
  get level() { return this.row === this.main ? this.y : this.strip; } // m, the same upwards
  get middle() { return (this.row + 0.5) * this.high; } // pixels

  // As many rows as there is room for, and road to fill them; `corridor`: see below. The main row leaves the others' level only
  // to keep its middle, what is followed, in sight.
  arrange(corridor, [x0, , x1]) {
    const road = Math.ceil(((x1 - x0) * this.scale) / this.width), [y0, y1] = corridor || [0, Infinity];
    this.rows = Math.max(Math.min(Math.floor(this.height / ((y1 - y0 + VERGE) * this.scale)), road, MOST_ROWS), 1);
    this.row = this.main;
    if (this.rows === 1) return;
    const aside = Math.max(this.high / 2 / this.scale - VERGE / 4, 0);
    this.strip = (y0 + y1) / 2;
    this.y = Math.min(Math.max(this.strip, this.y - aside), this.y + aside);
  }

  // Draw every row inside its own part of the canvas.
  eachRow(ctx, draw) {
    for (this.row = 0; this.row < this.rows; this.row++) {
      ctx.save();
      this.inPixels(ctx); ctx.beginPath(); ctx.rect(0, this.row * this.high, this.width, this.high); ctx.clip();
      draw();
      ctx.restore();
    }
    this.row = this.main;
  }

  resize() {
    const ratio = window.devicePixelRatio || 1;
    this.width = this.canvas.clientWidth; this.height = this.canvas.clientHeight;
    this.canvas.width = Math.round(this.width * ratio);
    this.canvas.height = Math.round(this.height * ratio);
    this.ratio = ratio;
  }

  // Draw in world metres from here on.
  inMetres(ctx) {
    const s = this.scale * this.ratio;
    ctx.setTransform(s, 0, 0, -s, (this.width / 2 - this.left * this.scale) * this.ratio,
      (this.middle + this.level * this.scale) * this.ratio);
  }

  inPixels(ctx) { ctx.setTransform(this.ratio, 0, 0, this.ratio, 0, 0); }

  toPixels(x, y) {
    return [this.width / 2 + (x - this.left) * this.scale, this.middle - (y - this.level) * this.scale];
  }

  toMetres(px, py) {
    this.row = Math.min(Math.max(Math.floor(py / this.high), 0), this.rows - 1);
    const found = [this.left + (px - this.width / 2) / this.scale, this.level - (py - this.middle) / this.scale];
    this.row = this.main;
    return found;
  }

  zoom(factor, px = this.width / 2, py = this.height / 2) {
    const [x, y] = this.toMetres(px, py);
    this.scale = Math.min(Math.max(this.scale * factor, 0.02), 60);
    const [nx, ny] = this.toMetres(px, py);
    this.x += x - nx; this.y += y - ny;
  }

  pan(dx, dy) { this.x -= dx / this.scale; this.y += dy / this.scale; }

  fit([x0, y0, x1, y1], margin = 1.06) {
    this.rows = 1; this.row = 0;
    this.x = (x0 + x1) / 2; this.y = (y0 + y1) / 2;
    this.scale = Math.min(this.width / Math.max(x1 - x0, 20), this.height / Math.max(y1 - y0, 20)) / margin;
  }

  // Whether a place is in the picture, and not at its edge.
  holds({ x, y }) {
    const [px, py] = this.toPixels(x, y), edge = 0.1;
    return px > edge * this.width && px < (1 - edge) * this.width && py > edge * this.height && py < (1 - edge) * this.height;
  }

  sees([x0, y0, x1, y1]) {
    const w = this.width / 2 / this.scale + 10, h = this.high / 2 / this.scale + 10;
    return x1 > this.left - w && x0 < this.left + w && y1 > this.level - h && y0 < this.level + h;
  }
}

// The box around boxes.
function bounds(lanes) {
  return lanes.reduce(([a, b, c, d], { box }) => [Math.min(a, box[0]), Math.min(b, box[1]), Math.max(c, box[2]),
    Math.max(d, box[3])], [Infinity, Infinity, -Infinity, -Infinity]);
}

// Where a track leads from its frame `begin` to its frame `end`.
function placed(track, begin, end) {
  const x = track.x.slice(begin, end + 1), y = track.y.slice(begin, end + 1);
  return { box: [Math.min(...x), Math.min(...y), Math.max(...x), Math.max(...y)] };
}

// From which y to which y most of a road lies that leads nowhere but right and left; null where it turns.
function corridor(lanes) {
  const pieces = [];
  for (const { x, y, box: [x0, y0, x1, y1] } of lanes) {
    if (y1 - y0 > 20 && y1 - y0 > 0.3 * (x1 - x0)) return null;
    for (let k = 1; k < x.length; k++) pieces.push([(y[k] + y[k - 1]) / 2, Math.abs(x[k] - x[k - 1])]);
  }
  pieces.sort(([a], [b]) => a - b);
  const total = pieces.reduce((sum, [, long]) => sum + long, 0);
  const at = (share) => { let sum = 0; return pieces.find(([, long]) => (sum += long) >= share * total)[0]; };
  return total ? [at(0.2), at(0.8)] : null;
}

function trace(ctx, line) {
  ctx.beginPath();
  for (let k = 0; k < line.x.length; k++) ctx.lineTo(line.x[k], line.y[k]);
}
