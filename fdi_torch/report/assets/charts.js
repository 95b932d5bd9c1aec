// Interactive charts of a report page. Each `figure[data-chart]` holds the JSON of `fdi_torch/report/chart.py` and a
// picture, which print and browsers without scripts show.
const root = document.documentElement;
const colour = name => getComputedStyle(root).getPropertyValue("--" + name).trim();
const element = (name, kind, text = "") => {
  const made = document.createElement(name);
  made.className = kind;
  made.textContent = text;
  return made;
};
const raised = power => [...power].map(sign => "⁰¹²³⁴⁵⁶⁷⁸⁹"["0123456789".indexOf(sign)] || "⁻").join("");
// "0.5", and "2·10⁻⁵" below a thousandth.
const text = (value, digits = 5) => {
  const number = Number(value.toPrecision(digits)), [factor, power] = number.toExponential().split("e");
  const plain = !number || Math.abs(number) >= 1e-3;
  const shown = plain ? String(number) : (Math.abs(factor) === 1 ? factor.replace("1", "") : `${factor}·`) + `10${raised(power)}`;
  return shown.replace("-", "\u2212");
};
const decoded = (code, Kind) => new Kind(Uint8Array.from(atob(code), letter => letter.charCodeAt(0)).buffer);
const unit = label => (label.includes(", ") ? " " + label.slice(label.lastIndexOf(", ") + 2) : "");

const MOST_LABELS = 4; // of marks
const LABEL = 15; // pixels of a line of a label
// Charts of one clock: they share crosshair and zoom.
class Clock {
  constructor(key) { this.key = key; this.charts = []; this.span = null; }
  extent() {
    const ends = this.charts.map(chart => chart.extent);
    return [Math.min(...ends.map(end => end[0])), Math.max(...ends.map(end => end[1]))];
  }
  zoom(low, high) {
    const [first, last] = this.extent(), least = (last - first) * 1e-5;
    if (!(high - low > least)) return;
    if (high - low >= last - first) this.span = null;
    else {
      const shift = Math.max(first - low, 0) + Math.min(last - high, 0);
      this.span = [low + shift, high + shift];
    }
    for (const chart of this.charts) chart.show();
  }
  reset() { this.span = null; for (const chart of this.charts) chart.show(); }
  by(factor, about = 0.5) {
    const [low, high] = this.span || this.extent(), centre = low + about * (high - low);
    this.zoom(centre - factor * (centre - low), centre + factor * (high - centre));
  }
  move(share) {
    if (!this.span) return;
    const step = share * (this.span[1] - this.span[0]);
    this.zoom(this.span[0] + step, this.span[1] + step);
  }
}
const clocks = new Map();
const clock = key => clocks.get(key) || clocks.set(key, new Clock(key)).get(key);

class Chart {
  constructor(figure) {
    this.figure = figure;
    this.about = JSON.parse(figure.dataset.chart);
    const times = this.about.clocks.map(code => Array.from(decoded(code, Float64Array)));
    const values = this.about.lines.map(line =>
      Array.from(decoded(line.y, Float32Array), value => (Number.isFinite(value) ? value : null)));
    const tables = times.map((time, k) => [time, ...values.filter((_, i) => this.about.lines[i].clock === k)]);
    this.lines = times.flatMap((_, k) => this.about.lines.filter(line => line.clock === k));
    this.data = tables.length > 1 ? uPlot.join(tables) : tables[0];
    const time = this.data[0];
    this.extent = [time[0], time[time.length - 1]];
    this.ratio = figure.querySelector("svg").viewBox.baseVal;
    this.ratio = this.ratio.height / this.ratio.width;
    this.clock = clock(figure.dataset.clock);
    this.clock.charts.push(this);
  }

  draw() {
    const host = element("div", "chart"), head = element("div", "chart-head");
    head.append(element("span", "chart-title", this.about.title), this.buttons());
    this.readout = element("div", "readout");
    this.place = element("span", "at");
    this.cells = this.lines.map(line => {
      const item = element("span", "of"), value = element("output", "");
      item.style.setProperty("--line", `var(--${line.colour})`);
      item.append(element("i", line.dashed ? "dashed" : ""), line.name, " ", value);
      this.readout.append(item);
      return value;
    });
    this.readout.append(this.place);
    this.field = element("div", "field");
    this.field.tabIndex = 0;
    this.field.setAttribute("role", "img");
    this.field.setAttribute("aria-label", `${this.about.title}: ${this.about.y} over ${this.about.x}`);
    this.note = element("div", "stretch");
    host.append(head, this.readout, this.field, ...(this.about.level === 0 ? [this.note] : []));
    this.figure.prepend(host);
    this.figure.classList.add("live");
    this.plot = new uPlot(this.options(), this.data, this.field);
    this.gestures(this.plot.over);
    this.field.addEventListener("keydown", event => this.key(event));
    new ResizeObserver(() => this.fit()).observe(this.field);
    this.show();
  }

  options() {
    const axis = (label, size) => ({
      label, size, labelSize: 18, labelGap: 0, gap: 4, font: "12px system-ui, sans-serif",
      labelFont: "12px system-ui, sans-serif", stroke: () => colour("soft"),
      grid: { stroke: () => colour("faint"), width: 0.6 },
      ticks: { stroke: () => colour("faint"), width: 0.6, size: 5 },
    });
    const [kind, width] = this.about.scale;
    // Powers of ten; with their double and fivefold where there are few.
    const decades = (plot, index, low, high) => {
      const first = Math.floor(Math.log10(kind === "log" ? low : width)), last = Math.ceil(Math.log10(high));
      const steps = last - first > 2 ? [1] : [1, 2, 5], ticks = kind === "log" ? [] : [0];
      for (let k = first; k <= last; k++) ticks.push(...steps.map(step => Number((step * 10 ** k).toPrecision(1))));
      const least = kind === "log" ? low : width;
      return ticks.filter(tick => tick === 0 || (tick >= least && tick <= high));
    };
    const plain = (plot, splits) => splits.map(value => (value === null ? null : text(value, 8)));
    const residual = this.about.level === 0;
    return {
      ...this.size(), legend: { show: false }, padding: [6 + LABEL * this.labelled().length, 20, 0, 0],
      scales: { x: { time: false, range: (plot, low, high) => this.clock.span || [low, high] }, y: this.range() },
      axes: [{ ...axis(this.about.axis, 26), values: plain },
             { ...axis(this.about.y, 50), values: plain, splits: kind === "linear" ? undefined : decades,
               filter: (plot, splits) => splits, size: (plot, values) =>
               16 + 7.6 * Math.max(3, ...(values || []).map(value => (value || "").length)) }],
      series: [{}, ...this.lines.map(line => ({
        label: line.name, stroke: () => colour(line.colour) + (line.wide ? "70" : ""), dash: line.dashed ? [6, 4] : undefined,
        width: line.wide ? 3 : residual ? 1 : 1.4,
        paths: line.steps ? uPlot.paths.stepped({ align: 1 }) : undefined, points: { show: this.sparse(), fill: () => colour(line.colour) },
      }))],
      cursor: {
        drag: { x: true, y: false, setScale: false },
        sync: { key: this.clock.key, setSeries: false, scales: ["x", null] },
        bind: {
          mousedown: (plot, over, act) => event => { if (event.button === 0 && !event.shiftKey) act(event); },
          dblclick: () => () => { this.clock.reset(); },
        },
      },
      hooks: {
        setCursor: [plot => this.read(plot.cursor.idx)],
        setSelect: [plot => this.select(plot)],
        drawAxes: [plot => this.marks(plot)],
        draw: [plot => this.labels(plot)],
      },
    };
  }

  range() {
    const [kind, width] = this.about.scale;
    if (kind === "log") return { distr: 3 };
    if (kind === "asinh") return { distr: 4, asinh: width, range: (plot, low, high) => [0, 1.3 * high] };
    return this.about.from_zero ? { range: (plot, low, high) => [0, 1.05 * (high || 1)] } : {};
  }

  // Few samples are drawn as points, so that a cut line says where it was measured.
  sparse() { return this.data[0].length < 3; }

  size() {
    const width = Math.max(this.field.clientWidth, 120);
    const enlarged = this.figure.closest("dialog");
    if (!enlarged) return { width, height: Math.round(Math.min(Math.max(0.86 * this.ratio * width, 130), 320)) };
    const count = enlarged.querySelectorAll("figure").length;
    return { width, height: Math.round(Math.max((innerHeight - 120) / count - 90, 130)) };
  }

  fit() {
    if (!this.field.clientWidth) return;  // in print
    const { width, height } = this.size();
    if (width !== this.plot.width || height !== this.plot.height) this.plot.setSize({ width, height });
  }

  show() {
    if (!this.plot) return;
    const [low, high] = this.clock.span || this.extent;
    this.plot.setScale("x", { min: low, max: high });
    this.figure.classList.toggle("zoomed", this.clock.span !== null);
    this.summary(low, high);
  }

  select(plot) {
    const { left, width } = plot.select;
    if (width > 3) this.clock.zoom(plot.posToVal(left, "x"), plot.posToVal(left + width, "x"));
    if (width) plot.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
  }

  read(index) {
    const inside = index !== null && index !== undefined;
    const at = this.data[0][index], zero = this.about.zero;
    const date = inside && zero !== null ? new Date(1000 * (zero + at)).toISOString().slice(0, 19).replace("T", " ") : "";
    this.place.textContent = inside ? `at ${text(at, 7)}${unit(this.about.x)}${date && ", " + date}` : "";
    this.cells.forEach((cell, i) => {
      const value = inside ? this.data[i + 1][index] : null;
      cell.textContent = value === null || value === undefined ? "" : text(value) + unit(this.about.y);
    });
  }

  // Mean and root mean square of the residuals of the stretch that is shown, part by part between its marks if these
  // are few.
  summary(low, high) {
    const inside = new Set(this.about.marks.map(mark => mark[0]).filter(moment => moment > low && moment < high));
    const ends = [low, ...(inside.size > MOST_LABELS ? [] : inside), high];
    const parts = ends.slice(0, -1).map((end, k) => this.part(end, ends[k + 1], !k));
    this.note.replaceChildren(...parts.filter(part => part).map(part => element("div", "", part)));
  }

  // Of the part after `low`, and with `low` if it is the first one, until `high`; not of thinned lines.
  part(low, high, first) {
    const from = `${text(low, 5)} to ${text(high, 5)}${unit(this.about.x)}`, words = [];
    if (this.about.level === 0) this.lines.forEach((line, i) => {
      if (!line.complete) return;
      const time = this.data[0];
      const begun = at => (first ? at >= low : at > low);
      const inside = this.data[i + 1].filter((value, k) => value != null && begun(time[k]) && time[k] <= high);
      if (!inside.length) return;
      const mean = inside.reduce((sum, value) => sum + value, 0) / inside.length;
      const square = Math.sqrt(inside.reduce((sum, value) => sum + value * value, 0) / inside.length);
      const name = this.lines.length > 1 ? line.name + ": " : "";
      words.push(`${name}mean ${text(mean, 3)}, rms ${text(square, 3)}${unit(this.about.y)}`);
    });
    return words.length ? [from, ...words].join(" \u00b7 ") : "";
  }

  marks(plot) {
    const { ctx, bbox } = plot, { left, top, width, height } = bbox;
    ctx.save();
    ctx.beginPath();
    ctx.rect(left, top, width, height);
    ctx.clip();
    const line = (x, y, to_x, to_y) => { ctx.beginPath(); ctx.moveTo(x, y); ctx.lineTo(to_x, to_y); ctx.stroke(); };
    ctx.lineWidth = devicePixelRatio;
    if (this.about.level !== null) {
      const y = plot.valToPos(this.about.level, "y", true);
      ctx.strokeStyle = colour("soft");
      if (this.about.level !== 0) ctx.setLineDash([2, 3]);
      line(left, y, left + width, y);
      ctx.setLineDash([]);
    }
    ctx.strokeStyle = colour("mark");
    for (const moment of this.about.events) {
      const x = plot.valToPos(moment, "x", true);
      line(x, top, x, top + height);
    }
    ctx.strokeStyle = colour("ink");
    ctx.setLineDash([2 * devicePixelRatio, 2 * devicePixelRatio]);
    for (const [moment] of this.about.marks) {
      const x = plot.valToPos(moment, "x", true);
      line(x, top, x, top + height);
    }
    ctx.restore();
  }

  // Marks whose labels are written: few.
  labelled() { return this.about.marks.length > MOST_LABELS ? [] : this.about.marks; }

  // The labels of marks above the lines, each on the side that has more room, in lines that fit there.
  labels(plot) {
    const { ctx, bbox: { left, top, width } } = plot, pixel = devicePixelRatio, labelled = this.labelled();
    ctx.save();
    ctx.font = `${12 * pixel}px system-ui, sans-serif`;
    let y = top - (LABEL * labelled.length - 9) * pixel;
    for (const [moment, label] of labelled) {
      const x = plot.valToPos(moment, "x", true), on_left = x > left + width / 2;
      if (x < left || x > left + width) continue;
      const room = (on_left ? x - left : left + width - x) - 8 * pixel, at = x + (on_left ? -4 : 4) * pixel;
      const fits = words => ctx.measureText(words).width <= room, lines = [""];
      for (const word of label.split(" ")) {
        const longer = `${lines.at(-1)} ${word}`.trim();
        if (fits(longer)) lines.splice(-1, 1, longer);
        else lines.push(word);
      }
      ctx.textAlign = on_left ? "right" : "left";
      for (const words of lines.filter(words => words)) {
        ctx.fillStyle = colour("ink");
        ctx.fillText(words, at, y);
        y += LABEL * pixel;
      }
    }
    ctx.restore();
  }

  buttons() {
    const row = element("span", "tools");
    const add = (sign, name, act, kind) => {
      const button = element("button", kind, sign);
      button.type = "button";
      button.title = name;
      button.setAttribute("aria-label", `${name}: ${this.about.title}`);
      button.addEventListener("click", act);
      row.append(button);
    };
    add("\u2039", "Earlier", () => this.clock.move(-0.25), "pan");
    add("\u203a", "Later", () => this.clock.move(0.25), "pan");
    add("\u2212", "Zoom out", () => this.clock.by(2), "pan");
    add("+", "Zoom in", () => this.clock.by(0.5), "near");
    add("Reset", "Show all", () => this.clock.reset(), "pan");
    add("Enlarge", "Enlarge", () => enlarge(this.figure), "near larger");
    return row;
  }

  key(event) {
    const acts = {
      "+": () => this.clock.by(0.5), "-": () => this.clock.by(2), "0": () => this.clock.reset(),
      "ArrowLeft": () => this.clock.move(-0.25), "ArrowRight": () => this.clock.move(0.25),
    };
    if (!acts[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
    acts[event.key]();
    event.preventDefault();
  }

  // Shift and drag, or one finger: pan. Control and wheel, or two fingers: zoom.
  gestures(over) {
    const fingers = new Map(), share = x => (x - over.getBoundingClientRect().left) / over.clientWidth;
    over.addEventListener("pointerdown", event => {
      if (event.pointerType === "mouse" && !event.shiftKey) return;
      fingers.set(event.pointerId, event.clientX);
      over.setPointerCapture(event.pointerId);
    });
    over.addEventListener("pointermove", event => {
      if (!fingers.has(event.pointerId)) return;
      const before = fingers.get(event.pointerId), others = [...fingers].filter(([id]) => id !== event.pointerId);
      if (others.length) {
        const fixed = others[0][1], now = event.clientX - fixed;
        if (Math.abs(now) > 10) this.clock.by(Math.abs((before - fixed) / now), share(fixed));
      } else this.clock.move(share(before) - share(event.clientX));
      fingers.set(event.pointerId, event.clientX);
    });
    for (const end of ["pointerup", "pointercancel"]) {
      over.addEventListener(end, event => fingers.delete(event.pointerId));
    }
    over.addEventListener("wheel", event => {
      if (!event.ctrlKey) return;
      event.preventDefault();
      this.clock.by(Math.exp(0.002 * event.deltaY), share(event.clientX));
    }, { passive: false });
  }
}
