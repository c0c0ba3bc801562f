// Numbers travel as [type, base64 of a little-endian array].
const TYPES = {i1: Int8Array, i2: Int16Array, i4: Int32Array, f4: Float32Array, f8: Float64Array};
// Over lanes and frames, what is constant is there once: `kinds` has a letter for each column, "f" for what is the same in
// all, "t" at each time the same in all lanes, "l" the same all the time in each lane, "v" for the rest, in this order.
const decode = ([type, text, kinds, lanes, frames, empty]) => {
  const found = new TYPES[type](Uint8Array.from(atob(text), c => c.charCodeAt(0)).buffer);
  if (!kinds) return found;
  const whole = new TYPES[type](lanes * frames * kinds.length);
  let start = 0;
  for (const kind of "ftlv") {
    const places = [...kinds].flatMap((letter, i) => letter === kind ? [i] : []);
    const [ofLane, ofFrame] = ["lv".includes(kind), "tv".includes(kind)], width = ofFrame ? frames : 1;
    for (let lane = 0; lane < lanes; lane++) {
      for (let frame = 0; frame < frames; frame++) {
        const row = start + ((ofLane ? lane * width : 0) + (ofFrame ? frame : 0)) * places.length;
        places.forEach((place, i) => { whole[(lane * frames + frame) * kinds.length + place] = found[row + i]; });
      }
    }
    start += (ofLane ? lanes : 1) * width * places.length;
  }
  const nothing = type[0] === "f" ? NaN : -(2 ** 15);
  empty.forEach(lane => whole.fill(nothing, lane * frames * kinds.length, (lane + 1) * frames * kinds.length));
  return whole;
};
