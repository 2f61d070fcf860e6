"use strict";
// Sorting, the choice of scenes, and the choice of test views; the libraries above do the rest.

for (const table of document.querySelectorAll("table.sortable")) new Tablesort(table);

const data = JSON.parse(document.getElementById("data").textContent);
const urls = [];
function url(number) { // a blob, so that an image is decoded once and the viewer may load it
  if (!urls[number]) {
    const bytes = Uint8Array.from(atob(data.images[number]), (character) => character.charCodeAt(0));
    urls[number] = URL.createObjectURL(new Blob([bytes], { type: "image/jpeg" }));
  }
  return urls[number];
}

// What is about other scenes than the chosen ones is hidden, and sections of which nothing is left.
const sets = document.getElementById("set");
sets.append(...Object.keys(data.sets).map((title) => new Option(title)));
sets.addEventListener("change", () => {
  const names = (data.sets[sets.value] ?? []).map((name) => name.replace(/[.*+?^${}()|[\]\\\/]/g, "\\$&"));
  const wanted = new RegExp(names.length ? `(?<![\\p{L}\\p{N}_-])(?:${names.join("|")})(?![\\p{L}\\p{N}_-])` : "", "u");
  for (const part of document.querySelectorAll("[data-of]")) part.hidden = !wanted.test(part.dataset.of);
  for (const section of document.querySelectorAll("section:has([data-of])")) {
    section.hidden = !section.querySelector("[data-of]:not([hidden])");
  }
  for (const more of document.querySelectorAll(".more")) more.open = names.length > 0;
});

// The numbers of the shown tables of a section, a line for each cell.
for (const link of document.querySelectorAll("a[download]")) {
  link.addEventListener("click", () => {
    const lines = [["block", "row", "column", "value", "text"]];
    for (const table of link.closest("section").querySelectorAll("[data-of]:not([hidden]) table")) {
      const columns = [...table.tHead.rows].at(-1).cells;
      for (const row of table.tBodies[0].rows) {
        for (const cell of [...row.cells].slice(1)) {
          const value = cell.dataset.sort === "-1e99" ? "" : cell.dataset.sort;
          const heading = columns[cell.cellIndex];
          const column = `${heading.dataset.group} ${heading.textContent}`;
          lines.push([table.caption.textContent, row.cells[0].textContent, column, value, cell.textContent]);
        }
      }
    }
    const text = lines.map((line) => line.map((word) => `"${word.trim().replaceAll('"', '""')}"`).join(",")).join("\r\n");
    link.href = URL.createObjectURL(new Blob([text], { type: "text/csv" }));
  });
}

if (data.scenes.length) {
  const select = Object.fromEntries(["scene", "view", "method", "pair"].map((id) => [id, document.getElementById(id)]));
  const slots = [...document.querySelectorAll("#slider figure")];
  const panels = [...document.querySelectorAll(".panoramas figure")];
  let viewers = [];

  const fill = (list, titles) => {
    const before = list.selectedOptions[0]?.textContent;
    list.replaceChildren(...titles.map((title, index) => new Option(title, index)));
    list.selectedIndex = Math.max(0, titles.findIndex((title) => name(title) === name(before ?? "")));
  };
  const name = (title) => title.replace(/, PSNR [\d.]+ dB$/, ""); // the PSNR behind a method differs between views

  const scene = () => data.scenes[select.scene.selectedIndex];
  const view = () => scene().views[select.view.selectedIndex];
  const method = () => view().methods[select.method.selectedIndex];

  function compare() {
    const shown = {
      truth: [view().truth, "ground truth"],
      render: [method().render, method().title],
      error: [method().error, "error"],
    };
    select.pair.value.split("-").forEach((what, index) => {
      slots[index].querySelector("img").src = url(shown[what][0]);
      slots[index].querySelector("figcaption").textContent = shown[what][1];
    });
  }

  function look() {
    const [first] = viewers;
    const direction = first ? { yaw: first.getYaw(), pitch: first.getPitch(), hfov: first.getHfov() } : { hfov: 100 };
    viewers.forEach((viewer) => viewer.destroy());
    viewers = [];
    document.getElementById("viewer").hidden = !view().panorama;
    if (!view().panorama) return;
    panels[1].querySelector("figcaption").textContent = method().title;
    viewers = [["panorama-truth", view().truth], ["panorama-render", method().render]].map(([id, number]) =>
      pannellum.viewer(id, {
        type: "equirectangular", panorama: url(number), autoLoad: true, showFullscreenCtrl: false,
        keyboardZoom: false, ignoreGPanoXMP: true, ...direction,
      }));
    window.viewers = viewers;
  }

  // The viewer that is used leads; the other follows, inertia included.
  let leader = 0;
  panels.forEach((panel, index) => {
    for (const event of ["pointerdown", "wheel", "keydown"]) {
      panel.addEventListener(event, () => { leader = index; }, { capture: true, passive: true });
    }
  });
  (function follow() {
    requestAnimationFrame(follow);
    if (viewers.length < 2 || !viewers.every((viewer) => viewer.isLoaded())) return;
    const [led, other] = [viewers[leader], viewers[1 - leader]];
    for (const angle of ["Yaw", "Pitch", "Hfov"]) {
      if (Math.abs(led[`get${angle}`]() - other[`get${angle}`]()) > 1e-3) other[`set${angle}`](led[`get${angle}`](), false);
    }
  })();

  const changed = {
    scene: () => fill(select.view, scene().views.map((item) => item.title)),
    view: () => fill(select.method, view().methods.map((item) => item.title)),
    method: () => { compare(); look(); },
  };
  const steps = Object.keys(changed);
  steps.forEach((step, index) => {
    select[step].addEventListener("change", () => steps.slice(index).forEach((later) => changed[later]()));
  });
  select.pair.addEventListener("change", compare);
  fill(select.scene, data.scenes.map((item) => item.title));
  steps.forEach((step) => changed[step]());
}
