"use strict";
const page = JSON.parse(document.getElementById("page-data").textContent);
const dark = window.matchMedia("(prefers-color-scheme: dark)");

function themed(layout) {
  const style = getComputedStyle(document.documentElement);
  const color = (name) => style.getPropertyValue(name).trim();
  const out = structuredClone(layout);
  for (const axis of ["xaxis", "yaxis", "yaxis2"]) {
    if (axis === "yaxis2" && !out.yaxis2) continue;
    out[axis] = { fixedrange: true, automargin: true, gridcolor: color("--grid"), zerolinecolor: color("--grid"), ...out[axis] };
  }
  return {
    dragmode: false,
    margin: { l: 10, r: 10, t: 10, b: 10 },
    paper_bgcolor: "rgba(0,0,0,0)",
    plot_bgcolor: "rgba(0,0,0,0)",
    font: { color: color("--text"), family: getComputedStyle(document.body).fontFamily, size: 13 },
    hoverlabel: { font: { size: 13 } },
    ...out,
  };
}

function draw(id, figure) {
  const place = document.getElementById(id);
  if (place && figure) Plotly.react(place, figure.data, themed(figure.layout), { displayModeBar: false, responsive: true });
}

function drawAll() {
  for (const [id, figure] of Object.entries(page.plots ?? {})) draw(id, figure);
  draw("progress-plot", page.progress);
  draw("labels-plot", page.labels);
  const select = document.getElementById("force-episode");
  if (select) draw("force-plot", page.force[select.selectedIndex]);
}

document.getElementById("force-episode")?.addEventListener("change", drawAll);
dark.addEventListener("change", drawAll);
drawAll();

function playable(video) {
  const source = document.getElementById(video.dataset.film);
  const bytes = Uint8Array.from(atob(source.textContent), (letter) => letter.charCodeAt(0));
  source.remove();
  video.src = URL.createObjectURL(new Blob([bytes], { type: "video/mp4" }));
}

for (const film of document.querySelectorAll(".film")) {
  const video = film.querySelector("video");
  const head = film.querySelector(".playhead");
  const now = film.querySelector(".now");
  const steps = Math.max(Number(film.dataset.steps), 1);
  const rate = Number(film.dataset.stepsPerSecond);
  const spans = [...film.querySelectorAll(".span")];
  const hint = now.innerHTML;

  function show(step) {
    head.style.left = `${(100 * Math.min(step, steps)) / steps}%`;
    const span = spans.findLast((each) => Number(each.dataset.step) <= step);
    if (span && step > 0) {
      const [title, rest] = [span.dataset.name, span.dataset.more];
      now.replaceChildren(Object.assign(document.createElement("b"), { textContent: title }), ` ${rest}`);
    } else {
      now.innerHTML = hint;
    }
  }

  if (video) {
    playable(video);
    const follow = () => show(video.currentTime * rate);
    video.addEventListener("timeupdate", follow);
    video.addEventListener("seeking", follow);
    video.addEventListener("play", function frame() {
      follow();
      if (!video.paused && !video.ended) requestAnimationFrame(frame);
    });
  }
  film.addEventListener("click", (event) => {
    const mark = event.target.closest("[data-step]");
    if (!mark) return;
    const step = Number(mark.dataset.step);
    if (video) video.currentTime = step / rate;
    show(step);
    if (mark.classList.contains("tick")) now.textContent = mark.title;
  });
}

for (const table of document.querySelectorAll("table.sortable")) {
  const body = table.tBodies[0];
  [...table.tHead.rows[0].cells].forEach((head, column) => {
    head.classList.add("sort");
    head.addEventListener("click", () => {
      const up = head.getAttribute("aria-sort") !== "ascending";
      for (const other of table.tHead.rows[0].cells) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", up ? "ascending" : "descending");
      const key = (row) => row.cells[column].dataset.value ?? row.cells[column].textContent;
      const order = (a, b) => {
        const [x, y] = [key(a), key(b)];
        return x !== "" && y !== "" && !isNaN(x) && !isNaN(y) ? Number(x) - Number(y) : x.localeCompare(y);
      };
      body.append(...[...body.rows].sort((a, b) => (up ? order(a, b) : order(b, a))));
    });
  });
}
