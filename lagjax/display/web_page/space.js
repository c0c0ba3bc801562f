// A film, or a still, of bodies, points and lines in space, painted on a canvas, the farthest face first, as `in_space/painting.py`
// paints the first frame. Drag to turn, wheel or pinch to zoom (about the pointer), shift and drag or two fingers to move,
// double-click for the first view; on the keyboard arrows, + and -, and Home.
const film = (root, spec) => {
  const {view, grid, look} = spec, first = root.querySelector("svg[data-space]");
  const canvas = document.createElement("canvas"), pen = canvas.getContext("2d");
  canvas.tabIndex = 0;
  canvas.setAttribute("role", "img");
  canvas.style.cssText = `display:block;width:${view.width}px;max-width:100%;aspect-ratio:${view.width}/${view.height};touch-action:none;cursor:grab`;
  first.replaceWith(canvas);
  const poses = decode(spec.poses), parts = spec.parts.map(part => ({...part, xyz: decode(part.xyz)}));
  const surfaces = spec.surfaces.map(s => ({...s, vertices: decode(s.vertices), faces: decode(s.faces), light: decode(s.light)}));
  let lane = 0, now = 0, said = "", seen = {...view, x: 0, y: 0, zoom: 1};

  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const less = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
  const plus = (a, s, b) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
  const turned = (rows, p) => plus(plus(plus([0, 0, 0], p[0], rows[0]), p[1], rows[1]), p[2], rows[2]);
  // A body's place and its axes in space, from its quaternion.
  const pose = (body, frame) => {
    const k = ((lane * spec.frames + frame) * spec.bodies + body) * 7, [x0, y0, z0, w, x, y, z] = poses.subarray(k, k + 7);
    return {at: [x0, y0, z0], axes: [
      [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
      [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
      [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]]};
  };
  const place = (anchor, frame) => {
    if (anchor.body === null) return anchor.point;
    const {at, axes} = pose(anchor.body, frame);
    return plus(at, 1, turned(axes, anchor.point));
  };
  // Three directions, the last along d, as `along` in `scenery.py`.
  const along = d => {
    const size = Math.sqrt(dot(d, d)), last = size > 0 ? d.map(x => x / size) : [0, 0, 1];
    const near = Math.abs(last[0]) > 0.9 ? [0, 1, 0] : [1, 0, 0], flat = plus(near, -dot(near, last), last);
    const one = flat.map(x => x / Math.sqrt(dot(flat, flat)));
    return [one, cross(last, one), last];
  };
  // Where the origin and the unit vectors of a solid's surface are in space.
  const frameOf = (shape, frame) => {
    const places = shape.anchors.map(anchor => place(anchor, frame));
    if (shape.kind === "rod") {
      const d = less(places[1], places[0]), axes = along(d), [a, b] = shape.size;
      return {at: plus(places[0], 0.5, d), axes: [axes[0].map(x => a * x), axes[1].map(x => b * x), d]};
    }
    const anchor = shape.anchors[0], rows = anchor.axes.map((axis, i) => axis.map(x => x * shape.size[i]));
    return {at: places[0], axes: anchor.body === null ? rows : rows.map(row => turned(pose(anchor.body, frame).axes, row))};
  };

  const draw = (frame, words) => {
    now = frame; said = words;
    const ratio = devicePixelRatio || 1, scale = canvas.clientWidth / view.width;
    const [w, h] = [view.width, view.height].map(x => Math.max(1, Math.round(x * scale * ratio)));
    if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
    pen.setTransform(w / view.width, 0, 0, h / view.height, 0, 0);
    pen.fillStyle = "#fff";
    pen.fillRect(0, 0, view.width, view.height);
    pen.lineCap = pen.lineJoin = "round";
    const a = seen.azimuth * Math.PI / 180, e = seen.elevation * Math.PI / 180;
    const right = [-Math.sin(a), Math.cos(a), 0], toward = [Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e)];
    const up = cross(toward, right), eye = plus(view.centre, view.distance, toward);
    const project = p => {
      const r = less(p, view.centre), near = dot(r, toward), s = seen.zoom * view.scale * view.distance / (view.distance - near);
      return [seen.x + seen.zoom * view.left + s * dot(r, right), seen.y + seen.zoom * view.top - s * dot(r, up), near];
    };
    const colour = ([r, g, b], white, bright) => `rgb(${[r, g, b].map(x => Math.round(bright * (x + white * (255 - x))))})`;
    const path = ends => { pen.beginPath(); ends.forEach(([x, y], i) => i ? pen.lineTo(x, y) : pen.moveTo(x, y)); };
    const stroke = (ends, style, width) => { path(ends); pen.strokeStyle = style; pen.lineWidth = width; pen.stroke(); };

    const marks = [];
    const line = (points, style, width, ahead = 0) => {
      for (let i = 0; i + 1 < points.length; i++) {
        const d = less(points[i + 1], points[i]), count = Math.ceil(Math.sqrt(dot(d, d)) / (look.piece * view.distance));
        const n = Math.min(Math.max(count, 1), look.pieces);
        for (let k = 0; k < n; k++) {
          const ends = [project(plus(points[i], k / n, d)), project(plus(points[i], (k + 1) / n, d))];
          marks.push([(ends[0][2] + ends[1][2]) / 2 + ahead, () => stroke(ends, style, width)]);
        }
      }
    };
    const dots = (points, style) => points.forEach(p => {
      const [x, y, near] = project(p);
      marks.push([near + 0.01 * view.distance, () => {
        pen.beginPath(); pen.arc(x, y, look.dot / 2, 0, 2 * Math.PI); pen.fillStyle = style; pen.fill();
      }]);
    });
    const solid = shape => {
      const {at, axes} = frameOf(shape, frame), {vertices, faces, light, closed} = surfaces[shape.surface];
      const corners = [];
      for (let k = 0; k < vertices.length; k += 3) corners.push(plus(at, 1, turned(axes, vertices.subarray(k, k + 3))));
      const flat = corners.map(project);
      for (let k = 0; k < faces.length; k += 4) {
        const [i, j, l, m] = faces.subarray(k, k + 4);
        const normal = cross(less(corners[l], corners[i]), less(corners[m], corners[j])), size = Math.sqrt(dot(normal, normal));
        const facing = dot(normal, less(eye, corners[i]));
        if (!size || (closed && facing <= 0)) continue;
        const bright = look.darkest + (1 - look.darkest) * (1 + Math.sign(facing) * dot(normal, look.light) / size) / 2;
        const style = colour(shape.color, look.lighter * light[k / 4], bright), ends = [flat[i], flat[j], flat[l], flat[m]];
        marks.push([(ends[0][2] + ends[1][2] + ends[2][2] + ends[3][2]) / 4, () => {
          path(ends); pen.closePath(); pen.fillStyle = style; pen.fill();
          // Covers the seam to the neighbour.
          pen.strokeStyle = style; pen.lineWidth = 0.8; pen.stroke();
        }]);
      }
    };
    const behind = Array.from({length: Math.min(frame, spec.trail) + 1}, (_, i) => Math.max(0, frame - spec.trail) + i);
    spec.shapes.forEach(shape => {
      const anchors = shape.anchors;
      if (shape.surface !== null) solid(shape);
      else if (shape.kind === "trail") line(behind.map(i => place(anchors[0], i)), colour(shape.color, look.trail, 1), look.thin);
      else {
        const points = anchors.map(anchor => place(anchor, frame)), style = colour(shape.color, 0, 1);
        line(points, style, look.line, ["mark", "gap"].includes(shape.kind) ? view.distance : 0);
        if (shape.kind === "dot") dots(points, style);
      }
    });
    parts.forEach(part => {
      const at = (i, j) => [...part.xyz.subarray(...[0, 3].map(c => ((lane * spec.frames + i) * part.points + j) * 3 + c))];
      const points = Array.from({length: part.points}, (_, j) => at(frame, j)), style = colour(part.color, 0, 1);
      if (!points.flat().every(Number.isFinite)) return;
      line(points, style, look.line);
      if (part.points <= look.marked) dots(points, style);
      line(behind.map(i => at(i, part.points - 1)), colour(part.color, look.trail, 1), look.thin);
    });
    marks.sort((one, other) => one[0] - other[0]);
    const above = seen.elevation >= 0;
    if (above) floor();
    marks.forEach(mark => mark[1]());
    if (!above) floor();
    const empty = parts.length && !spec.bodies && !Number.isFinite(parts[0].xyz[lane * spec.frames * parts[0].points * 3]);
    canvas.setAttribute("aria-label", `${spec.about}${empty ? ", no motion to draw" : words && ", " + words}. Arrow keys turn it, + and - zoom.`);

    function floor() {
      const {x, y, z, floor: low} = grid, [x0, x1, y0, y1] = [x[0], x.at(-1), y[0], y.at(-1)].map(line => line[0]), grey = "#d1d1d1";
      x.forEach(([at]) => stroke([project([at, y0, low]), project([at, y1, low])], grey, 0.8));
      y.forEach(([at]) => stroke([project([x0, at, low]), project([x1, at, low])], grey, 0.8));
      pen.font = "11px sans-serif"; pen.fillStyle = "#333"; pen.textBaseline = "middle";
      const text = (words, p, align = "center") => { pen.textAlign = align; pen.fillText(words, p[0], p[1]); };
      const out = look.out * Math.max(x1 - x0, y1 - y0);
      const beside = (axis, from, to, far) => toward[axis] > 0 ? to + far * out : from - far * out;
      x.forEach(([at, label]) => text(label, project([at, beside(1, y0, y1, 1), low])));
      y.forEach(([at, label]) => text(label, project([beside(0, x0, x1, 1), at, low])));
      text("x", project([(x0 + x1) / 2, beside(1, y0, y1, 2.2), low]));
      text("y", project([beside(0, x0, x1, 2.2), (y0 + y1) / 2, low]));
      if (Math.abs(toward[2]) >= 0.97) return;
      const [cx, cy] = [[x0, y0], [x0, y1], [x1, y0], [x1, y1]].sort((p, q) => project([...p, low])[0] - project([...q, low])[0])[0];
      const top = project([cx, cy, z.at(-1)[0]]);
      stroke([project([cx, cy, low]), top], grey, 0.8);
      z.forEach(([at, label]) => text(label + " \u2013", project([cx, cy, at]), "right"));
      text("z", [top[0], top[1] - 14]);
    }
  };
  // A still has no controls.
  const show = spec.frames > 1 ? player(root, spec, draw) : () => draw(0, ""), again = () => draw(now, said);

  const turn = (across, down) => {
    seen.azimuth -= across;
    seen.elevation = Math.min(90, Math.max(-90, seen.elevation + down));
    again();
  };
  const zoom = (by, x, y) => {
    by = Math.min(1000, Math.max(0.1, seen.zoom * by)) / seen.zoom;
    seen.zoom *= by; seen.x = x - by * (x - seen.x); seen.y = y - by * (y - seen.y);
    again();
  };
  const inside = event => {
    const box = canvas.getBoundingClientRect(), scale = view.width / box.width;
    return [(event.clientX - box.left) * scale, (event.clientY - box.top) * scale];
  };
  const fingers = new Map();
  const middle = () => {
    const [p, q] = [...fingers.values()];
    return {at: [(p[0] + q[0]) / 2, (p[1] + q[1]) / 2], apart: Math.hypot(p[0] - q[0], p[1] - q[1]) || 1};
  };
  canvas.onpointerdown = event => { fingers.set(event.pointerId, inside(event)); canvas.setPointerCapture(event.pointerId); };
  canvas.onpointerup = canvas.onpointercancel = event => fingers.delete(event.pointerId);
  canvas.onpointermove = event => {
    const from = fingers.get(event.pointerId), to = inside(event);
    if (!from) return;
    if (fingers.size === 2) {
      const before = middle();
      fingers.set(event.pointerId, to);
      const after = middle();
      seen.x += after.at[0] - before.at[0]; seen.y += after.at[1] - before.at[1];
      zoom(after.apart / before.apart, ...after.at);
      return;
    }
    fingers.set(event.pointerId, to);
    const [dx, dy] = [to[0] - from[0], to[1] - from[1]];
    if (event.shiftKey) { seen.x += dx; seen.y += dy; again(); } else turn(0.5 * dx, 0.5 * dy);
  };
  canvas.addEventListener("wheel", event => {
    event.preventDefault();
    zoom(Math.exp(-0.0015 * event.deltaY * (event.deltaMode ? 30 : 1)), ...inside(event));
  }, {passive: false});
  const reset = () => { seen = {...view, x: 0, y: 0, zoom: 1}; again(); };
  canvas.ondblclick = reset;
  canvas.onkeydown = event => {
    const keys = {ArrowLeft: [-5, 0], ArrowRight: [5, 0], ArrowUp: [0, 5], ArrowDown: [0, -5]}, by = {"+": 1.2, "=": 1.2, "-": 1 / 1.2}[event.key];
    if (keys[event.key]) turn(...keys[event.key]);
    else if (by) zoom(by, view.width / 2, view.height / 2);
    else if (event.key === "Home") reset();
    else return;
    // In a notebook the arrow keys would move on to the next cell.
    event.preventDefault(); event.stopPropagation();
  };
  new ResizeObserver(again).observe(canvas);
  show();
  return which => { lane = which; show(); };
};
