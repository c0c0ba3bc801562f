// Lines over axes with round ticks, in an SVG as wide as there is room.
const SVG = "http://www.w3.org/2000/svg";
const element = (parent, name, attributes = {}, text = null) => {
  const made = parent instanceof SVGElement || name === "svg" ? document.createElementNS(SVG, name) : document.createElement(name);
  Object.entries(attributes).forEach(([key, value]) => made.setAttribute(key, value));
  if (text !== null) made.textContent = text;
  return parent.appendChild(made);
};
const short = x => {
  if (!Number.isFinite(x)) return String(x);
  const size = Math.abs(x);
  return size !== 0 && (size < 1e-4 || size >= 1e6) ? x.toExponential(4) : String(+x.toPrecision(6));
};
const ticks = (low, high, most) => {
  const rough = (high - low) / most, power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map(m => m * power).find(step => step >= rough * 0.999);
  const found = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + 1e-9 * step; i++) found.push(i * step);
  return found.map(x => [x, short(+x.toPrecision(12))]);
};
// The least and the largest of what is finite; null where nothing is.
const extent = arrays => {
  let low = Infinity, high = -Infinity;
  for (const x of arrays) {
    for (const value of x) {
      if (Number.isFinite(value)) { low = Math.min(low, value); high = Math.max(high, value); }
    }
  }
  return low > high ? null : [low, high];
};
// The same with some room; never of no width.
const range = (arrays, room = 0) => {
  const [low, high] = extent(arrays) || [0, 1];
  const wide = high - low > 1e-12 * Math.max(Math.abs(low), Math.abs(high)) ? high - low : Math.abs(high) || 1;
  return high - low === wide ? [low - room * wide, high + room * wide] : [low - 0.5 * wide, high + 0.5 * wide];
};
const chart = (host, label) => {
  const figure = element(host, "figure"), svg = element(figure, "svg", {role: "img"}), names = element(figure, "figcaption");
  let shown = null;
  // curves: [{name, x, y, colour, dash}]; limits: [[x, x], [y, y]]; mark: [x, y] or null.
  const draw = given => {
    shown = given;
    const {across, curves, limits, mark, words} = given;
    const width = Math.max(260, figure.clientWidth || 640), height = 240, [left, right, top, bottom] = [64, 12, 12, 44];
    const [[x0, x1], [y0, y1]] = limits;
    const toX = x => left + (x - x0) / (x1 - x0) * (width - left - right);
    const toY = y => height - bottom - (y - y0) / (y1 - y0) * (height - top - bottom);
    svg.replaceChildren();
    for (const [key, value] of Object.entries({viewBox: `0 0 ${width} ${height}`, width, height})) svg.setAttribute(key, value);
    svg.setAttribute("aria-label", `${label} over ${across}; ${words}`);
    const clip = `${unique}-${label.replace(/[^a-zA-Z0-9]/g, "-")}-clip`;
    const inside = {x: left, y: top - 2, width: width - left - right, height: height - top - bottom + 4};
    element(element(svg, "clipPath", {id: clip}), "rect", inside);
    for (const [x, text] of ticks(x0, x1, width / 90)) {
      element(svg, "path", {d: `M${toX(x)} ${top}V${height - bottom}`, class: "grid"});
      element(svg, "text", {x: toX(x), y: height - bottom + 17, "text-anchor": "middle"}, text);
    }
    for (const [y, text] of ticks(y0, y1, 5)) {
      element(svg, "path", {d: `M${left} ${toY(y)}H${width - right}`, class: "grid"});
      element(svg, "text", {x: left - 6, y: toY(y) + 4, "text-anchor": "end"}, text);
    }
    element(svg, "path", {d: `M${left} ${top}V${height - bottom}H${width - right}`, class: "frame"});
    element(svg, "text", {x: (left + width - right) / 2, y: height - 8, "text-anchor": "middle", class: "name"}, across);
    const upright = `translate(14 ${(top + height - bottom) / 2}) rotate(-90)`;
    element(svg, "text", {transform: upright, "text-anchor": "middle", class: "name"}, label);
    const lines = element(svg, "g", {"clip-path": `url(#${clip})`, fill: "none", "stroke-width": 1.8, "stroke-linejoin": "round"});
    for (const {name, x, y, colour, dash} of curves) {
      let d = "", drawing = false;
      for (let i = 0; i < y.length; i++) {
        const there = Number.isFinite(x[i]) && Number.isFinite(y[i]);
        if (there) d += `${drawing ? "L" : "M"}${toX(x[i]).toFixed(1)} ${toY(y[i]).toFixed(1)}`;
        drawing = there;
      }
      element(lines, "path", {d, stroke: colour, "stroke-dasharray": dash, "data-curve": name});
    }
    if (mark && mark.every(Number.isFinite)) element(svg, "circle", {cx: toX(mark[0]), cy: toY(mark[1]), r: 5, class: "mark"});
    if (curves.length > 1 && !names.children.length) {
      for (const {name, colour, dash} of curves) {
        const entry = element(names, "span"), swatch = element(entry, "svg", {width: 28, height: 10, "aria-hidden": "true"});
        element(swatch, "path", {d: "M1 5H27", stroke: colour, "stroke-width": 2, "stroke-dasharray": dash});
        element(entry, "span", {}, name);
      }
    }
  };
  // What a window that changes its width needs.
  let width = 0;
  new ResizeObserver(() => { if (shown && figure.clientWidth !== width) { width = figure.clientWidth; draw(shown); } }).observe(figure);
  return draw;
};
