// One slider an axis; the lane at their places is what all pictures show. The last axis is the fastest.
const COLOURS = spec.colours, DASHES = ["none", "8 3", "8 3 2 3", "2 3", "12 3 2 3 2 3", "14 4", "1 3"];
const controls = element(root.querySelector("[data-controls]"), "div", {class: "controls"});
const status = root.querySelector("[data-status]"), views = root.querySelector("[data-views]");
const lengths = spec.axes.map(axis => axis.labels.length), place = spec.start.slice();
const laneAt = place => place.reduce((lane, i, k) => lane * lengths[k] + i, 0);
const codes = decode(spec.status);
let moved = spec.axes.length - 1, same = true;

const outputs = spec.axes.map((axis, k) => {
  const row = element(controls, "div", {class: "row"}), id = `${unique}-axis-${k}`;
  element(row, "label", {for: id}, axis.name);
  const slider = element(row, "input", {type: "range", id, min: 0, max: lengths[k] - 1, step: 1, value: place[k]});
  slider.value = place[k];
  const output = element(row, "output", {for: id});
  slider.oninput = () => { place[k] = +slider.value; moved = k; show(); };
  // In a notebook the arrow keys would move on to the next cell.
  slider.onkeydown = event => event.stopPropagation();
  return {slider, output};
});

const playing = spec.film ? film(root, spec.film) : null;
const numbers = spec.numbers.map(({name, values}) => ({name, values: decode(values)}));
const list = numbers.length ? element(views, "dl") : null;
const told = numbers.map(({name}) => { element(list, "dt", {}, name); return element(list, "dd"); });
const sections = numbers.map(({name}) => chart(views, name));
const panels = spec.panels.map(panel => ({
  ...panel,
  xs: decode(panel.x),
  ys: panel.curves.map(curve => decode(curve.y)),
  draw: chart(views, panel.label),
}));
panels.forEach(panel => {
  panel.all = [range([panel.xs]), range(panel.ys, 0.05)];
  // Times that all lanes share are there once.
  panel.of = lane => panel.xs.length === panel.length ? panel.xs : panel.xs.subarray(lane * panel.length, (lane + 1) * panel.length);
});
numbers.forEach(number => { number.all = range([number.values], 0.05); });
if (panels.length || numbers.length) {
  const row = element(controls, "div", {class: "row"}), box = element(row, "input", {type: "checkbox", id: `${unique}-same`});
  box.checked = true;
  element(row, "label", {for: box.id, class: "wide"}, "one scale for all points");
  box.onchange = () => { same = box.checked; show(); };
}

const show = () => {
  const lane = laneAt(place);
  const point = spec.axes.map((axis, k) => `${axis.name} = ${axis.labels[place[k]]}`).join(", ");
  outputs.forEach(({slider, output}, k) => {
    output.textContent = spec.axes[k].labels[place[k]];
    slider.setAttribute("aria-valuetext", `${spec.axes[k].name} ${spec.axes[k].labels[place[k]]}`);
  });
  const well = spec.trusted.includes(codes[lane]);
  status.textContent = `${point}: ${well ? "" : "not ok, "}${spec.words[codes[lane]]}`;
  status.classList.toggle("bad", !well);
  root.dataset.lane = lane;
  numbers.forEach((number, k) => {
    const axis = spec.axes[moved], along = place.slice(), value = number.values[lane];
    const y = axis.at.map((_, i) => { along[moved] = i; return number.values[laneAt(along)]; });
    told[k].textContent = short(value);
    sections[k]({
      across: axis.name,
      curves: [{name: number.name, x: axis.at, y, colour: COLOURS[0], dash: "none"}],
      limits: [range([axis.at], 0.02), same ? number.all : range([y], 0.05)],
      mark: [axis.at[place[moved]], value],
      words: `at ${point}: ${short(value)}`,
    });
  });
  panels.forEach(panel => {
    const x = panel.of(lane), ys = panel.ys.map(y => y.subarray(lane * panel.length, (lane + 1) * panel.length));
    const between = extent(ys), style = i => ({colour: COLOURS[i % COLOURS.length], dash: DASHES[i % DASHES.length]});
    panel.draw({
      across: panel.across,
      curves: panel.curves.map(({name}, i) => ({name, x, y: ys[i], ...style(i)})),
      limits: same ? panel.all : [range([x]), range(ys, 0.05)],
      mark: null,
      words: `at ${point} ${between ? `between ${short(between[0])} and ${short(between[1])}` : "there is no value"}`,
    });
  });
  if (playing) playing(lane);
};
show();
