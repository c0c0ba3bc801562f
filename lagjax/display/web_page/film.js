// A film in an SVG that stands there with its first frame: points, lines that link them, and trails.
// Of several lanes, `show` chooses one; they share their times. NOWHERE marks a lane without a motion.
const NOWHERE = -32768;
const film = (root, spec) => {
  const groups = root.querySelectorAll("g[data-part]"), svg = groups[0].ownerSVGElement, controls = root.querySelector("[data-film]");
  const [button, slider, clock] = ["button", "input", "output"].map(name => controls.querySelector(name));
  const parts = spec.parts.map(part => ({size: 2 * part.points, xy: decode(part.xy)}));
  let lane = 0, began = null;
  const draw = frame => {
    const empty = parts[0].xy[lane * spec.frames * parts[0].size] === NOWHERE;
    parts.forEach((part, k) => {
      const at = i => part.xy.subarray((lane * spec.frames + i) * part.size, (lane * spec.frames + i + 1) * part.size);
      const [trail, line, dots] = groups[k].children, points = empty ? [] : at(frame);
      let behind = "";
      for (let i = Math.max(0, frame - spec.trail); i <= frame && !empty; i++) behind += at(i).slice(-2).join(" ") + " ";
      trail.setAttribute("points", behind);
      line.setAttribute("points", points.join(" "));
      let marks = "";
      for (let j = 0; j < points.length; j += 2) marks += `M${points[j]} ${points[j + 1]}h0`;
      if (dots) dots.setAttribute("d", marks);
    });
    const words = "t = " + (spec.start + frame * spec.step).toFixed(spec.digits);
    clock.textContent = words;
    slider.setAttribute("aria-valuetext", words);
    svg.setAttribute("aria-label", `${spec.about}, ${empty ? "no motion to draw" : words}`);
  };
  const pause = () => { began = null; button.textContent = "\u25b6"; button.setAttribute("aria-label", "play"); };
  const advance = now => {
    if (began === null || !root.isConnected) return;
    slider.value = Math.floor(Math.max(0, now - began) / 1000 * spec.rate) % spec.frames;
    draw(+slider.value);
    requestAnimationFrame(advance);
  };
  const play = () => {
    began = performance.now() - slider.value / spec.rate * 1000;
    button.textContent = "\u275a\u275a";
    button.setAttribute("aria-label", "pause");
    requestAnimationFrame(advance);
  };
  button.onclick = () => began === null ? play() : pause();
  slider.oninput = () => { pause(); draw(+slider.value); };
  // The space bar plays from the slider, too; the arrow keys are the browser's own.
  slider.onkeydown = event => { if (event.key === " ") { event.preventDefault(); event.stopPropagation(); button.click(); } };
  draw(+slider.value);
  return which => { lane = which; draw(+slider.value); };
};
