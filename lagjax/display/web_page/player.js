// The controls of a film: a button, a slider and a clock. `draw(frame, clock)` paints one frame.
const player = (root, spec, draw) => {
  const controls = root.querySelector("[data-film]");
  const [button, slider, clock] = ["button", "input", "output"].map(name => controls.querySelector(name));
  let began = null;
  const show = () => {
    const words = "t = " + (spec.start + slider.value * spec.step).toFixed(spec.digits);
    clock.textContent = words;
    slider.setAttribute("aria-valuetext", words);
    draw(+slider.value, words);
  };
  const pause = () => { began = null; button.textContent = "\u25b6"; button.setAttribute("aria-label", "play"); };
  const advance = now => {
    if (began === null || !root.isConnected) return;
    slider.value = Math.floor(Math.max(0, now - began) / 1000 * spec.rate) % spec.frames;
    show();
    requestAnimationFrame(advance);
  };
  const play = () => {
    began = performance.now() - slider.value / spec.rate * 1000;
    button.textContent = "\u275a\u275a";
    button.setAttribute("aria-label", "pause");
    requestAnimationFrame(advance);
  };
  button.onclick = () => began === null ? play() : pause();
  slider.oninput = () => { pause(); show(); };
  // The space bar plays from the slider, too; the arrow keys are the browser's own.
  slider.onkeydown = event => { if (event.key === " ") { event.preventDefault(); event.stopPropagation(); button.click(); } };
  return show;
};
