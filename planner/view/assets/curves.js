(() => {
  const block = document.getElementById("curves");
  if (!block) return;
  const data = JSON.parse(block.textContent), film = document.querySelector("video");
  const charts = [...document.querySelectorAll("svg[data-chart]")], [left, , across] = data.box;
  const slider = Object.assign(document.createElement("input"), {type: "range", min: data.start, max: data.end,
    step: (data.end - data.start) / 1000, value: data.start, id: "time"});
  slider.setAttribute("aria-label", "time, s");
  const now = Object.assign(document.createElement("output"), {id: "now"});
  const bar = Object.assign(document.createElement("p"), {className: "bar"});
  bar.append(slider, now);
  if (film) {  // below it: a player's own controls hide the verdict that is written at its foot
    film.removeAttribute("controls");
    const play = Object.assign(document.createElement("button"), {type: "button", textContent: "\u25b6"});
    const toggle = () => film.paused ? film.play() : film.pause();
    play.setAttribute("aria-label", "play or pause");
    [play, film].forEach(one => one.addEventListener("click", toggle));
    ["play", "pause"].forEach(name => film.addEventListener(name, () => {
      play.textContent = film.paused ? "\u25b6" : "\u275a\u275a"; }));
    bar.prepend(play);
    film.after(bar);
  } else document.querySelector(".charts").before(bar);
  let hovered = false;
  const clip = t => Math.min(data.end, Math.max(data.start, t));
  const round = v => Math.abs(v) >= 1e5 || (v && Math.abs(v) < 1e-3) ? v.toExponential(3) : +v.toPrecision(4) + "";
  const words = v => round(v).replace("-", "\u2212"), modes = {plan: "plan ", gains: "gains ", open: "open loop "};
  function valueAt(line, t) {
    let a = 0, b = line.t.length - 1;
    if (b < 0 || t > line.t[b] + 1e-6 * (data.end - data.start)) return null;
    while (b - a > 1) { const m = (a + b) >> 1; if (line.t[m] <= t) a = m; else b = m; }
    if (line.stepwise) return t >= line.t[b] ? line.y[b] : line.y[a];
    const part = b > a ? Math.min(1, Math.max(0, (t - line.t[a]) / (line.t[b] - line.t[a]))) : 0;
    return line.y[a] + part * (line.y[b] - line.y[a]);
  }
  function show(t) {
    now.value = "t = " + t.toFixed(3) + " s";
    slider.value = t;
    const x = left + across * (t - data.start) / ((data.end - data.start) || 1);
    charts.forEach((svg, i) => {
      const cursor = svg.querySelector(".cursor"), by = new Map();
      cursor.setAttribute("x1", x); cursor.setAttribute("x2", x); cursor.style.visibility = "visible";
      data.charts[i].forEach(line => {
        const v = valueAt(line, t);
        if (!by.has(line.label)) by.set(line.label, []);
        if (v !== null) by.get(line.label).push([modes[line.kind], words(v)]);
      });
      const unit = data.units[i] ? " " + data.units[i] : "";
      const lines = [...by].map(([label, values]) => label + " " + (values.every(([, v]) => v === values[0][1])
        ? (values[0] || ["", "unknown"])[1] : values.map(pair => pair.join("")).join(", ")) + unit);
      svg.parentNode.querySelector("output").textContent = lines.join(" \u00b7 ");
    });
  }
  const ofFilm = () => clip(data.start + film.currentTime * data.speed);
  function seek(t) {
    show(t);
    document.dispatchEvent(new CustomEvent("planner-time", {detail: t}));
    if (film) film.currentTime = (t - data.start) / data.speed;
  }
  const timeAt = (svg, event) => {
    const box = svg.getBoundingClientRect();
    const x = (event.clientX - box.left) * data.width / box.width;
    return clip(data.start + (x - left) / across * (data.end - data.start));
  };
  charts.forEach(svg => {
    svg.addEventListener("pointermove", event => {
      hovered = true;
      const t = timeAt(svg, event);
      if (event.buttons & 1) seek(t); else show(t);
    });
    svg.addEventListener("pointerleave", () => { hovered = false; if (film) show(ofFilm()); });
    svg.addEventListener("click", event => seek(timeAt(svg, event)));
  });
  document.addEventListener("planner-shown", event => { if (!hovered) show(clip(event.detail)); });  // by the 3-D view
  slider.addEventListener("input", () => { if (film) film.pause(); seek(+slider.value); });
  if (film) {
    const follow = () => { if (!hovered) show(ofFilm()); if (!film.paused) requestAnimationFrame(follow); };
    film.addEventListener("play", follow);
    film.addEventListener("seeked", () => { if (!hovered) show(ofFilm()); });
  }
  show(data.start);
})();
