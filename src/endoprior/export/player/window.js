// How the page uses its window: controls that fold away, few of them where it is small, and full screen.

const RESTS_AFTER = 3000; // ms without a touch: full screen shows the image alone

class PageWindow {
  constructor(body) {
    this.body = body;
    // A phone turned sideways, or an upright one whose controls would leave no room for the image.
    this.low = window.matchMedia("(max-height: 520px), (max-width: 480px) and (max-height: 720px)");
    this.resting = 0;
    this.low.addEventListener("change", () => this.arrange());
    document.addEventListener("fullscreenchange", () => document.fullscreenElement || this.setFull(false));
    for (const name of ["pointerdown", "pointermove", "keydown"]) document.addEventListener(name, () => this.wake());
    this.arrange();
  }

  get folded() {
    return this.body.classList.contains("folded");
  }

  get full() {
    return this.body.classList.contains("full");
  }

  // Such windows and full screen begin with the controls folded.
  arrange() {
    const compact = this.low.matches || this.full;
    if (compact !== this.body.classList.contains("compact")) this.setFolded(compact);
    this.body.classList.toggle("compact", compact);
  }

  setFolded(folded) {
    this.body.classList.toggle("folded", folded);
    const label = folded ? "All controls" : "Fewer controls";
    byId("fold").setAttribute("aria-expanded", !folded);
    byId("fold").setAttribute("aria-label", label);
  }

  // The page fills its window where the browser has no full screen, as on an iPhone.
  setFull(full) {
    if (full === this.full) return;
    this.body.classList.toggle("full", full);
    byId("full").setAttribute("aria-pressed", full);
    if (full && document.fullscreenEnabled) document.documentElement.requestFullscreen().catch(() => {});
    if (!full && document.fullscreenElement) document.exitFullscreen();
    this.arrange();
    this.wake();
  }

  wake() {
    this.body.classList.remove("resting");
    clearTimeout(this.resting);
    if (this.full && this.folded) this.resting = setTimeout(() => this.body.classList.add("resting"), RESTS_AFTER);
  }
}
