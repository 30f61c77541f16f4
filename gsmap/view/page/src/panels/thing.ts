// One object or one localised photograph.
import { css, html, nothing } from "lit";
import { customElement } from "lit/decorators.js";
import * as actions from "../actions";
import { relative } from "../api";
import type { GraphEntry, ObjectEntry, PhotoEntry } from "../contract";
import * as derive from "../derive";
import { day, metres, moment, plural, point, titleOf } from "../words";
import { Panel } from "./base";
import { shared } from "./css";
import { heading } from "./heading";
import { icon } from "./icons";
import { whereItIs } from "./plan";
import { waiting } from "./waiting";
import type { Vector } from "../contract";

@customElement("gs-thing")
export class Thing extends Panel {
  static override styles = [
    shared,
    heading.styles,
    css`
      .picture {
        display: block;
        width: 100%;
        aspect-ratio: 4 / 3; /* of every picture of an object, so that nothing moves when it comes */
        object-fit: contain;
        border-radius: 6px;
        background: #000;
      }
      .picture + section {
        margin-top: 18px;
      }
      form input {
        min-width: 0;
      }
    `,
  ];

  protected override render() {
    const { state } = this;
    const photo = derive.selectedPhoto(state);
    if (photo) return this.photo(photo);
    const key = state.selection?.key;
    const known = actions.graphOf(state);
    if (!known) return heading("This map has no graph", "");
    return waiting(
      known,
      "Loading the objects",
      () => actions.graphs.forget(),
      (graph) => {
        const object = graph.objects.find((one) => one.id === key);
        return object
          ? this.object(object, graph)
          : html`${heading("No such object", "")}
              <div class="body"><p>This map knows no object ${key}: it may have been merged with another.</p></div>`;
      },
    );
  }

  private unit(component: number): number {
    return (this.state.map && derive.componentOf(this.state.map, component)?.metres_per_unit) ?? 1;
  }

  private object(one: ObjectEntry, graph: GraphEntry) {
    const unit = this.unit(one.component);
    const named = (id: string) => {
      const found = graph.objects.find((other) => other.id === id);
      return found ? titleOf(found) : id;
    };
    const picture = relative(one.picture);
    const room = graph.rooms.find(({ id }) => id === one.room);
    const relations = graph.relations.filter(({ subject, other }) => [subject, other].includes(one.id));
    const sides = one.box[1].map((v, i) => metres((v - (one.box[0][i] ?? v)) * unit));
    return html`
      ${heading(titleOf(one), html`<span class="mark ${one.there ? "good" : "hollow"}">${one.there ? "there" : "gone"}</span> <span>${one.id}</span>`, true)}
      <div class="body">
        ${picture ? html`<img class="picture" src=${picture} alt="Picture of ${titleOf(one)}" />` : nothing}
        <section class="row">
          ${actions.mayAct(this.state) ? this.naming(one) : nothing}
          ${
            actions.has3D(this.state)
              ? html`<button @click=${() => actions.flyToSelected()}>${icon("fly")} Fly to it</button>`
              : nothing
          }
        </section>
        ${whereItIs()}
        <section>
          <dl class="facts">
            <dt>At</dt>
            <dd>${point(one.position, unit)}</dd>
            <dt>Size</dt>
            <dd>${sides.join(" × ")}</dd>
            ${
              room
                ? html`<dt>Room</dt>
                    <dd>
                      ${room.id}, ${room.area_m2.toFixed(1)}
                      m²${room.doors.length ? `, with doors to ${room.doors.join(", ")}` : ""}
                    </dd>`
                : nothing
            }
            <dt>Seen</dt>
            <dd>${plural(one.seen, "time")}</dd>
            <dt>First seen</dt>
            <dd>${day(one.first_seen)}</dd>
            <dt>Last seen</dt>
            <dd>${day(one.last_seen)}</dd>
          </dl>
        </section>
        ${
          relations.length
            ? html`<section>
                <h3>How it stands to others</h3>
                <ul>
                  ${relations.map(
                    (row) => html`<li class="anywhere">${named(row.subject)} ${row.relation} ${named(row.other)}</li>`,
                  )}
                </ul>
              </section>`
            : nothing
        }
      </div>
    `;
  }

  private naming(one: ObjectEntry) {
    const send = (event: Event) => {
      event.preventDefault();
      const input = (event.target as HTMLFormElement).querySelector("input");
      const name = input?.value.trim() ?? "";
      if (name !== one.name) void actions.nameObject(one.id, name, one.name);
      input?.blur();
    };
    return html`<form class="row grow" @submit=${send}>
      <input
        id="name"
        class="grow"
        maxlength="100"
        aria-label="Name of ${one.id}"
        placeholder="Give it a name"
        .value=${one.name}
      />
      <button type="submit" ?disabled=${this.state.busy !== null}>Name it</button>
    </form>`;
  }

  private photo(one: PhotoEntry) {
    const [fx, , ,] = one.intrinsics_px;
    const wide = (2 * Math.atan(one.size_px[0] / (2 * fx)) * 180) / Math.PI;
    const at = [0, 1, 2].map((r) => one.T_map_camera[r]?.[3] ?? 0) as Vector;
    return html`
      ${heading(one.file, "photograph, localised", true)}
      <div class="body">
        ${
          actions.has3D(this.state)
            ? html`<section class="row">
                <button class="main" @click=${() => actions.flyToSelected()}>
                  ${icon("fly")} Stand where it was taken
                </button>
              </section>`
            : nothing
        }
        <section>
          <dl class="facts">
            <dt>Taken at</dt>
            <dd>${point(at, this.unit(one.component))}</dd>
            <dt>Taken on</dt>
            <dd>${moment(one.captured_at)}</dd>
            <dt>Picture</dt>
            <dd>${one.size_px.join(" × ")}</dd>
            <dt>Angle of view</dt>
            <dd>${wide.toFixed(0)}° wide</dd>
          </dl>
        </section>
      </div>
    `;
  }
}
