// Search, state and kind. A red row, one with a bad answer to a stop, passes every filter.
import { el, setText } from "./dom.js";
import { H } from "./history-strings.js";

const chosen = { text: "", state: "all", kind: "" };

export class Filter {
  // `kindText` names a robot's kind; `changed` is called after a choice. All views share the choice.
  constructor(fleet, kindText, changed, prefix = "") {
    this.fleet = fleet;
    this.kindText = kindText;
    this.search = el("input", { id: `${prefix}search`, type: "search", placeholder: H.searchHint, autocomplete: "off", spellcheck: "false" });
    this.state = el("select", { id: `${prefix}filter` });
    for (const [value, text] of Object.entries(H.filters)) this.state.append(el("option", { value, text }));
    this.kind = el("select", { id: `${prefix}filter-kind` }, el("option", { value: "", text: H.allKinds }));
    this.count = el("span", { id: `${prefix}count`, class: "count", role: "status" });
    this.hiddenCount = el("span", { id: `${prefix}hidden-count`, class: "hidden-count" });
    this.node = el("div", { class: "tools filter" }, el("label", { for: this.search.id, text: H.search }), this.search,
      el("label", { for: this.state.id, text: H.state }), this.state, el("label", { for: this.kind.id, text: H.kind }), this.kind, this.count, this.hiddenCount);
    for (const control of [this.search, this.state, this.kind]) {
      control.addEventListener("input", () => {
        Object.assign(chosen, { text: this.search.value, state: this.state.value, kind: this.kind.value });
        changed();
      });
    }
  }

  // Shows what another view has chosen.
  open() {
    this.search.value = chosen.text;
    this.state.value = chosen.state;
    this.listKinds();
  }

  listKinds() {
    const kinds = [...new Set([...this.fleet.rows.values()].map(this.kindText))].filter(Boolean).sort();
    const listed = kinds.join("\n");
    if (listed !== this.listed && document.activeElement !== this.kind) {
      this.listed = listed;
      this.kind.replaceChildren(el("option", { value: "", text: H.allKinds }), ...kinds.map((text) => el("option", { value: text, text })));
    }
    const known = [...this.kind.options].some((each) => each.value === chosen.kind);
    if (!known) this.kind.append(el("option", { value: chosen.kind, text: chosen.kind }));
    if (this.kind.value !== chosen.kind) this.kind.value = chosen.kind;
  }

  passes(row) {
    if (this.fleet.attention(row) === 0) return true;
    const wanted = chosen.text.trim().toLowerCase();
    if (wanted && !`${row.id} ${row.kind} ${this.kindText(row)} ${row.task.instruction || ""}`.toLowerCase().includes(wanted)) return false;
    if (chosen.kind && this.kindText(row) !== chosen.kind) return false;
    const { fleet } = this;
    switch (chosen.state) {
      case "attention": return fleet.attention(row) < 5;
      case "moving": return fleet.moving(row);
      case "idle": return !fleet.moving(row) && row.locked === false;
      case "locked": return Boolean(row.locked);
      case "silent": return fleet.stale(row);
      default: return true;
    }
  }

  get everything() { return chosen.state === "all" && !chosen.kind && chosen.text.trim() === ""; }

  tell(shown, more = "") {
    this.listKinds();
    setText(this.count, H.shown(shown, this.fleet.rows.size) + more);
    setText(this.hiddenCount, H.hidden(this.fleet.rows.size - shown));
  }
}
