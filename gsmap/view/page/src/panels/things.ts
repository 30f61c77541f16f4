// Objects of the map and photographs that were localised in it.
import { css, html, nothing } from "lit";
import { customElement, state } from "lit/decorators.js";
import * as actions from "../actions";
import { relative } from "../api";
import type { ObjectEntry, PhotoEntry } from "../contract";
import * as derive from "../derive";
import { page } from "../state";
import { day, plural, sizeOf, titleOf } from "../words";
import { Panel } from "./base";
import { shared } from "./css";
import "./listing";
import { waiting } from "./waiting";

@customElement("gs-things")
export class Things extends Panel {
  static override styles = [
    shared,
    css`
      :host {
        display: grid;
        grid-template-rows: auto auto minmax(0, 1fr);
        gap: 10px;
      }
      gs-listing {
        margin: 0 -8px;
        padding: 0 4px;
        min-height: 200px;
      }
      .list {
        display: grid;
        grid-template-rows: auto minmax(0, 1fr);
        gap: 8px;
        min-height: 0;
      }
    `,
  ];

  @state() private kind: "objects" | "photos" = "objects";

  protected override render() {
    const { map, component } = this.state;
    if (!map) return nothing;
    const photos = map.photos.filter((photo) => photo.component === component);
    const press = (kind: "objects" | "photos") => (this.kind = kind);
    return html`
      <div class="segments" role="group" aria-label="Which things">
        <button aria-pressed=${this.kind === "objects"} @click=${() => press("objects")}>Objects</button>
        <button aria-pressed=${this.kind === "photos"} @click=${() => press("photos")}>
          Photos <span class="muted">${photos.length}</span>
        </button>
      </div>
      <input
        id="filter"
        type="search"
        aria-label="Find by name"
        placeholder=${this.kind === "objects" ? "Find an object by name or room" : "Find a photo by file or date"}
        .value=${this.state.thingQuery}
        @input=${(event: Event) => page.set({ thingQuery: (event.target as HTMLInputElement).value })}
      />
      ${this.kind === "photos" ? this.photos(photos) : this.objects()}
    `;
  }

  private objects() {
    const known = actions.graphOf(this.state);
    if (!known || (known.status === "ready" && !known.value.objects.length))
      return html`<p class="empty">
        No objects are known. They come with describing (<kbd>gsmap update</kbd>) and are followed over the captures by
        <kbd>gsmap graph</kbd>.
      </p>`;
    return waiting(
      known,
      "Loading the objects",
      () => actions.graphs.forget(),
      ({ objects }) => {
        const listed = derive.listedObjects(this.state, objects);
        return listed.length
          ? this.list("Objects", listed, (one) => one.id, this.object, "object")
          : html`<p class="empty">No object of this component fits.</p>`;
      },
    );
  }

  private photos(photos: readonly PhotoEntry[]) {
    if (!photos.length)
      return html`<p class="empty">No photos were localised here: <kbd>gsmap localize MAP photos/</kbd> does that.</p>`;
    const listed = derive.listedPhotos(this.state);
    return listed.length
      ? this.list("Photos", listed, (one) => one.file, this.photo, "photo")
      : html`<p class="empty">No photo fits “${this.state.thingQuery}”.</p>`;
  }

  private list<T>(
    label: string,
    items: readonly T[],
    keyOf: (item: T) => string,
    row: (item: T) => unknown,
    kind: "object" | "photo",
  ) {
    const { selection } = this.state;
    return html`<div class="list">
      <p class="muted small" role="status">${plural(items.length, kind)}</p>
      <gs-listing
        label=${label}
        rem=${kind === "object" ? "4.4" : "3.4"}
        .items=${items}
        .keyOf=${keyOf}
        .row=${row}
        .chosen=${selection?.kind === kind ? selection.key : null}
        .stamp=${page.state}
      ></gs-listing>
    </div>`;
  }

  private readonly object = (one: ObjectEntry) => {
    const { map } = this.state;
    const unit = (map && derive.componentOf(map, one.component)?.metres_per_unit) ?? 1;
    const picture = relative(one.picture);
    const hover = () => actions.hover(one.id);
    const leave = () => actions.hover(null);
    return html`<span
      role="gridcell"
      class="wide ${one.there ? "" : "off"}"
      @pointerenter=${hover}
      @pointerleave=${leave}
      @focusin=${hover}
      @focusout=${leave}
      ><button
        class="choose pictured"
        title=${titleOf(one)}
        @click=${() => actions.select({ kind: "object", key: one.id })}
      >
        ${picture ? html`<img src=${picture} alt="Picture of ${one.id}" loading="lazy" decoding="async" width="76" height="52" />` : nothing}
        <span class="name">${titleOf(one)}</span>
        <span class="detail">${sizeOf(one, unit)}</span>
        <span class="detail"
          ><span>${one.room ?? ""}</span
          ><span>${one.there ? (one.last_seen ? day(one.last_seen) : nothing) : "gone"}</span></span
        >
      </button></span
    >`;
  };

  private readonly photo = (one: PhotoEntry) =>
    html`<span role="gridcell" class="wide"
      ><button class="choose" title=${one.file} @click=${() => actions.select({ kind: "photo", key: one.file })}>
        <span class="name">${one.file}</span>
        <span class="detail"><span>${one.size_px.join(" × ")}</span><span>${day(one.captured_at)}</span></span>
      </button></span
    >`;
}
