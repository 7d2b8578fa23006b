"use strict";
(() => {
  const root = document.documentElement, fade = document.getElementById("fade"), blink = document.getElementById("blink");
  if (!fade) return;
  let timer = null;
  const show = (share) => root.style.setProperty("--drr", share);
  const stop = () => {
    clearInterval(timer);
    timer = null;
    blink.setAttribute("aria-pressed", "false");
    show(fade.value / 100);
  };
  const start = () => {
    let on = false;
    blink.setAttribute("aria-pressed", "true");
    timer = setInterval(() => show((on = !on) ? 1 : 0), 600);
  };
  fade.addEventListener("input", stop);
  blink.addEventListener("click", () => (timer === null ? start() : stop()));
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.id === "theatre") return;
    if (event.key === "b" || event.key === "B") blink.click();
    if ((event.key === "ArrowLeft" || event.key === "ArrowRight") && event.target.id !== "fade") {
      fade.value = Number(fade.value) + (event.key === "ArrowRight" ? 10 : -10);
      stop();
    }
  });
  const layers = [...document.querySelectorAll("[data-layer]")];
  for (const box of document.querySelectorAll("[data-shows]")) {
    const update = () => {
      for (const layer of layers) if (layer.dataset.layer === box.dataset.shows) layer.classList.toggle("off", !box.checked);
    };
    box.addEventListener("change", update);
    update();
  }
  for (const button of document.querySelectorAll(".enlarge")) {
    button.addEventListener("click", () => {
      const large = button.closest(".panel").classList.toggle("large");
      button.setAttribute("aria-pressed", String(large));
    });
  }
  // what is folded away is printed too
  let opened = [];
  addEventListener("beforeprint", () => {
    opened = [...document.querySelectorAll("details:not([open])")];
    for (const part of opened) part.open = true;
  });
  addEventListener("afterprint", () => {
    for (const part of opened) part.open = false;
  });
})();
