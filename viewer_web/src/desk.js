// The operator's desk: the contacts, how each is judged, bookmarked aspects and kept rulers. What is judged is
// sent to the server item by item with the revision that was seen, so that two pages that judge at once lose
// nothing; it is the only thing that the page writes.

export const newId = (kind) => `${kind}-${Date.now().toString(36)}${Math.random().toString(36).slice(2, 8)}`;
const $ = (id) => document.getElementById(id);
const make = (tag, has = {}, ...children) => { const e = Object.assign(document.createElement(tag), has); e.append(...children); return e; };

export class Desk {
  constructor(app) {
    this.app = app;
    this.drafts = new Map(); // contact → what is written and not yet kept
    $("judge").addEventListener("input", (e) => { if (e.target.name === "remark" || e.target.name === "operator") this.draft(); });
    $("judge").addEventListener("change", () => { this.draft(); this.keepJudgement(); });
    $("judge").addEventListener("submit", (e) => { e.preventDefault(); this.keepJudgement(); });
    $("bookmark").onclick = () => this.bookmark();
    try { this.operator = localStorage.getItem("csas-operator") ?? ""; } catch { this.operator = ""; }
  }

  get items() { return this.app.scene.desk?.items ?? {}; }
  get closed() { return this.app.scene.desk?.why ?? "connecting"; }
  of(kind) { return Object.entries(this.items).filter(([, item]) => item.kind === kind); }

  // One change at a time, in order: the next one knows the revision that the last one made.
  send(id, kind, value) {
    this.sending = (this.sending ?? Promise.resolve()).then(async () => {
      const base = this.items[id]?.revision ?? 0;
      try {
        const answer = await fetch("api/desk", { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ items: [{ id, kind, base: this.seen?.[id] ?? base, value }] }) });
        if (!answer.ok) throw new Error(await answer.text());
        const document = await answer.json();
        if (document.revision >= (this.app.scene.desk?.revision ?? 0)) this.app.scene.desk = { why: "", revision: document.revision, items: document.items };
        this.say("kept in the results folder");
      } catch (error) {
        this.say(`not kept: ${error.message || "the viewer is away"}`, true);
      }
      this.show();
      this.app.dirty();
    });
    return this.sending;
  }

  say(text, bad = false) {
    $("kept").textContent = text;
    $("kept").classList.toggle("bad", bad);
  }

  // Contacts

  choose(id, go = true) {
    this.app.state.contact = id;
    this.app.casts.clear();
    this.app.derive();
    this.show();
    this.app.dimensions();
    if (go) {
      this.app.zoomToContact();
      this.goTo3d();
    }
    this.app.save();
    this.app.dirty();
  }

  step(by) {
    const all = this.app.scene.contacts ?? [], at = all.findIndex((c) => c.id === this.app.contact?.id);
    if (all.length) this.choose(all[(at + by + all.length) % all.length].id);
  }

  goTo3d() {
    const { app } = this, place = app.place;
    if (app.solid && place) app.solid.look([place.centre[0], place.centre[1], place.height / 3], 1.8 * Math.max(place.size, 0.4));
  }

  show() {
    const { app } = this, contacts = app.scene.contacts ?? [], chosen = app.contact, list = $("contacts"), report = app.scene.report;
    // Only what differs is made anew: what has the focus keeps it.
    const told = JSON.stringify([contacts, app.scene.live, chosen?.id, this.of("judgement").map(([id, i]) => [id, i.value.verdict]), report?.quality]);
    if (told !== this.told) {
      this.told = told;
      const focused = document.activeElement?.dataset?.contact;
      list.replaceChildren(...contacts.map((c) => this.row(c, c.id === chosen?.id)));
      if (focused) list.querySelector(`[data-contact="${CSS.escape(focused)}"]`)?.focus();
      const q = report?.quality, verdict = report ? [q ? `${report.verdict}; the result is ${q.verdict}` : report.verdict, ...(report.why_no_object && !contacts.length ? [report.why_no_object] : []), ...(q?.reasons ?? [])].filter(Boolean) : [];
      $("verdict").textContent = verdict.length ? `${verdict[0]}${verdict.length > 1 ? `: ${verdict.slice(1).join("; ")}` : ""}` : contacts.length ? "" : app.scene.live ? "No contact yet." : "This run tells of no contact.";
      $("verdict").dataset.quality = q?.verdict ?? "";
    }
    this.facts(chosen, report);
    this.form(chosen);
    this.lists();
  }

  row(c, chosen) {
    const d = c.dimensions, judged = this.items[c.id]?.value.verdict;
    const size = d ? `${d.length_m.toFixed(2)} × ${d.width_m.toFixed(2)} × ${d.height_m.toFixed(2)} m` : c.reason ?? c.kind;
    const button = make("button", { type: "button", onclick: () => this.choose(c.id) }, make("b", { textContent: c.name }), make("span", { textContent: size }), make("span", { className: "judged", textContent: judged ?? "" }));
    button.dataset.contact = c.id;
    button.setAttribute("aria-pressed", String(chosen));
    if (judged) button.dataset.verdict = judged;
    if (c.strong) button.dataset.strong = "1";
    return make("li", {}, button);
  }

  facts(c, report) {
    const lines = [];
    if (c?.reason) lines.push(`${c.strong ? "May be an object" : "Left out"}: ${c.reason}.`);
    if (c) lines.push(`At x ${c.position_m[0].toFixed(2)} m, y ${c.position_m[1].toFixed(2)} m${c.geographic ? `; ${degrees(c.geographic[0], "NS")} ${degrees(c.geographic[1], "EW")}` : ""}.`);
    const v = report?.views;
    if (c?.kind === "object" && v) {
      lines.push(`Views: ${c.views_used ?? v.used ?? "—"} used${v.in ? ` of ${v.in}` : ""}${v.rejected ? `, ${v.rejected} rejected` : ""}${v.lost ? `, ${v.lost} lost` : ""}.`);
      for (const [reason, n] of Object.entries(v.reasons ?? {})) lines.push(`${n} rejected: ${reason}.`);
    }
    if (c?.volume === "main" && report?.heights?.length) {
      const h = report.heights.map(([, m]) => m).sort((a, b) => a - b);
      lines.push(`Heights by view: median ${report.height_median_m.toFixed(2)} m, nine of ten from ${h[Math.floor(0.05 * h.length)].toFixed(2)} to ${h[Math.ceil(0.95 * h.length) - 1].toFixed(2)} m (bars round the picture).`);
    }
    if (c?.volume === "main" && report?.hollows?.voxels) lines.push(`Hollows that no shadow shows, but echoes do: ${report.hollows.volume_m3.toFixed(3)} m³.`);
    const other = this.app.scene.other;
    if (other) lines.push(`Run B (${other.title}) is moved by ${other.moved_m.toFixed(2)} m, so that its contact lies where the first run's does.${other.damage ? ` Its damage: ${other.damage}` : ""}`);
    for (const problem of this.app.scene.damage ? this.app.scene.damage.split("; ") : []) lines.push(`Damage: ${problem}.`);
    for (const problem of report?.problems ?? []) lines.push(`Damage: ${problem}.`);
    if (report?.version) lines.push(`Made by csas-shadow ${report.version}.`);
    const text = lines.join("\n");
    if ($("facts").dataset.text === text) return;
    $("facts").dataset.text = text;
    $("facts").replaceChildren(...lines.map((line) => make("p", { textContent: line })));
  }

  // Judgement

  form(c) {
    const form = $("judge"), item = c && this.items[c.id], draft = c && this.drafts.get(c.id), value = draft ?? item?.value ?? { verdict: "", remark: "", operator: this.operator };
    $("judged-what").textContent = c ? `${c.name} is` : "No contact to judge";
    for (const field of form.querySelectorAll("input, textarea, button")) field.disabled = !c || !!this.closed;
    for (const radio of form.querySelectorAll("[name=verdict]")) radio.checked = radio.value === value.verdict;
    for (const name of ["remark", "operator"]) if (form[name] !== document.activeElement && form[name].value !== (value[name] ?? "")) form[name].value = value[name] ?? "";
    if (this.shownContact !== c?.id) for (const name of ["remark", "operator"]) form[name].value = value[name] ?? "";
    this.shownContact = c?.id;
    const earlier = item?.earlier ?? [];
    $("earlier").textContent = earlier.length ? `Also: ${earlier.map((e) => `${e.value.verdict}${e.value.operator ? ` by ${e.value.operator}` : ""}${e.value.remark ? ` (${e.value.remark})` : ""}`).join("; ")}` : "";
    $("bookmark").disabled = !!this.closed;
    if (this.closed) this.say(this.closed, true);
    else if (item && !$("kept").textContent) this.say(`judged ${item.time.slice(0, 16).replace("T", " ")}Z`);
  }

  draft() {
    const c = this.app.contact, form = $("judge");
    if (!c) return;
    // What was seen when writing began is what the change is based on.
    this.seen ??= {};
    if (!this.drafts.has(c.id)) this.seen[c.id] = this.items[c.id]?.revision ?? 0;
    this.drafts.set(c.id, { verdict: form.verdict.value, remark: form.remark.value, operator: form.operator.value });
  }

  async keepJudgement() {
    const c = this.app.contact, value = c && this.drafts.get(c.id);
    if (!value || this.closed) return;
    if (!value.verdict) return this.say("choose a verdict first", true);
    this.operator = value.operator;
    try { localStorage.setItem("csas-operator", value.operator); } catch { /* a file has no storage in some browsers */ }
    await this.send(c.id, "judgement", value);
    if (!$("kept").classList.contains("bad")) {
      // What was written meanwhile goes on from what has just been kept.
      if (this.drafts.get(c.id) !== value) this.seen[c.id] = this.items[c.id]?.revision ?? 0;
      else {
        this.drafts.delete(c.id);
        delete this.seen[c.id];
      }
    }
  }

  // Bookmarks and rulers

  bookmark() {
    const view = this.app.current;
    if (view) this.send(newId("bookmark"), "bookmark", { aspect_deg: view.aspect_deg, name: "" });
  }

  keptRulers() {
    const desk = this.app.scene.desk;
    if (!this.rulers || this.rulersOf !== desk) {
      this.rulersOf = desk;
      const held = new Map((this.rulers ?? []).map((r) => [r.id, r]));
      // One that is being moved keeps its ends.
      this.rulers = this.of("ruler").map(([id, { value }]) => (held.get(id)?.touched ? held.get(id) : Object.assign(held.get(id) ?? { id, kept: true }, { stamp: value.stamp, aspect_deg: value.aspect_deg, ends: structuredClone(value.ends) })));
      const there = new Set(this.rulers.map((r) => r.id));
      this.app.rulers = this.app.rulers.filter((r) => !there.has(r.id));
      if (this.app.ruler && there.has(this.app.ruler.id)) this.app.ruler = this.rulers.find((r) => r.id === this.app.ruler.id);
    }
    return this.rulers;
  }

  keepRuler(ruler) {
    return this.send(ruler.id, "ruler", { stamp: ruler.stamp, aspect_deg: ruler.aspect_deg, ends: ruler.ends.map((end) => end.map((v) => +v.toFixed(4))), name: "" });
  }

  dropRuler(ruler) {
    if (this.app.ruler === ruler) this.app.ruler = null;
    if (ruler.kept) this.send(ruler.id, "ruler", null);
    else this.app.rulers = this.app.rulers.filter((r) => r !== ruler);
    this.app.save();
    this.later();
    this.app.dirty();
  }

  later() { this.timer ??= setTimeout(() => { this.timer = undefined; this.lists(); }, 50); }

  lists() {
    const { app } = this, gone = !!this.closed;
    const entry = (text, go, buttons) => make("li", {}, make("button", { type: "button", onclick: go, textContent: text }), ...buttons);
    const small = (text, label, onclick) => { const b = make("button", { type: "button", textContent: text, title: label, onclick, className: "small" }); b.setAttribute("aria-label", label); return b; };
    const marks = this.of("bookmark").sort(([, a], [, b]) => a.value.aspect_deg - b.value.aspect_deg);
    const rulers = app.allRulers(), told = JSON.stringify([marks, gone, rulers.map((r) => [r.id, r.kept, r.ends, r.aspect_deg])]);
    if (told === this.listed) return;
    this.listed = told;
    $("bookmarks").replaceChildren(...marks.map(([id, { value }]) => {
      const name = `${value.aspect_deg.toFixed(1)}°${value.name ? ` ${value.name}` : ""}`;
      return entry(name, () => app.setAspect(value.aspect_deg), gone ? [] : [small("×", `Remove bookmark ${name}`, () => this.send(id, "bookmark", null))]);
    }));
    $("rulers").replaceChildren(...rulers.map((r) => {
      const m = app.measured(r), name = `${r.aspect_deg.toFixed(1)}°: ${m.height === undefined ? `${m.distance.toFixed(2)} m` : `h ${m.height.toFixed(2)} m`}`;
      const buttons = [];
      if (!r.kept && !gone) buttons.push(small("keep", `Keep ruler ${name}`, () => this.keepRuler(r)));
      if (!r.kept || !gone) buttons.push(small("×", `Remove ruler ${name}`, () => this.dropRuler(r)));
      return entry(name, () => { app.ruler = r; app.setAspect(r.aspect_deg); }, buttons);
    }));
  }
}

function degrees(value, sides) { return `${Math.abs(value).toFixed(6)}° ${sides[value < 0 ? 1 : 0]}`; }
