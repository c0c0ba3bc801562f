// A film in an SVG that stands there with its first frame: points, lines that link them, and trails.
// Of several lanes, `show` chooses one; they share their times. NOWHERE marks a lane without a motion.
const NOWHERE = -32768;
const film = (root, spec) => {
  const groups = root.querySelectorAll("g[data-part]"), svg = groups[0].ownerSVGElement;
  const parts = spec.parts.map(part => ({size: 2 * part.points, xy: decode(part.xy)}));
  let lane = 0;
  const show = player(root, spec, (frame, words) => {
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
    svg.setAttribute("aria-label", `${spec.about}, ${empty ? "no motion to draw" : words}`);
  });
  show();
  return which => { lane = which; show(); };
};
