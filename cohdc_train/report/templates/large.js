// A click on a figure shows it as large as the window; a second click shows its own size.
const dialog = document.getElementById("large");
const stage = dialog.querySelector("div");
const open = (media) => {
  const shown = [...media.querySelectorAll("svg, img")].find((item) => item.getClientRects().length);
  if (!shown) return;
  stage.replaceChildren(shown.cloneNode(true));
  stage.className = "";
  dialog.showModal();
};
for (const media of document.querySelectorAll(".media")) {
  media.addEventListener("click", () => open(media));
  media.addEventListener("keydown", (event) => {
    if (event.key !== "Enter" && event.key !== " ") return;
    event.preventDefault();
    open(media);
  });
}
stage.addEventListener("click", () => stage.classList.toggle("zoomed"));
dialog.querySelector("button").addEventListener("click", () => dialog.close());
dialog.addEventListener("click", (event) => event.target === dialog && dialog.close());
