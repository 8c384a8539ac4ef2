// The camera: world metres (y up) to pixels and back, zoom about a point, follow a vehicle.

class View {
  constructor(canvas) {
    this.canvas = canvas;
    this.x = 0; this.y = 0; // m, the middle of the picture
    this.scale = 5; // pixels per m
    this.width = this.height = 1;
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
    ctx.setTransform(s, 0, 0, -s, (this.width / 2 - this.x * this.scale) * this.ratio,
      (this.height / 2 + this.y * this.scale) * this.ratio);
  }

  inPixels(ctx) { ctx.setTransform(this.ratio, 0, 0, this.ratio, 0, 0); }

  toPixels(x, y) {
    return [this.width / 2 + (x - this.x) * this.scale, this.height / 2 - (y - this.y) * this.scale];
  }

  toMetres(px, py) {
    return [this.x + (px - this.width / 2) / this.scale, this.y - (py - this.height / 2) / this.scale];
  }

  zoom(factor, px = this.width / 2, py = this.height / 2) {
    const [x, y] = this.toMetres(px, py);
    this.scale = Math.min(Math.max(this.scale * factor, 0.02), 60);
    const [nx, ny] = this.toMetres(px, py);
    this.x += x - nx; this.y += y - ny;
  }

  pan(dx, dy) { this.x -= dx / this.scale; this.y += dy / this.scale; }

  fit([x0, y0, x1, y1], margin = 1.06) {
    this.x = (x0 + x1) / 2; this.y = (y0 + y1) / 2;
    this.scale = Math.min(this.width / Math.max(x1 - x0, 20), this.height / Math.max(y1 - y0, 20)) / margin;
  }

  sees([x0, y0, x1, y1]) {
    const w = this.width / 2 / this.scale + 10, h = this.height / 2 / this.scale + 10;
    return x1 > this.x - w && x0 < this.x + w && y1 > this.y - h && y0 < this.y + h;
  }
}

function bounds(lanes) {
  return lanes.reduce(([a, b, c, d], { box }) => [Math.min(a, box[0]), Math.min(b, box[1]), Math.max(c, box[2]),
    Math.max(d, box[3])], [Infinity, Infinity, -Infinity, -Infinity]);
}

function trace(ctx, line) {
  ctx.beginPath();
  for (let k = 0; k < line.x.length; k++) ctx.lineTo(line.x[k], line.y[k]);
}
