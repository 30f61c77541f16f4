// The clip box in numbers, for who does not drag its handles.
import { css, html, nothing } from "lit";
import { customElement } from "lit/decorators.js";
import * as actions from "../actions";
import * as derive from "../derive";
import { Panel } from "./base";
import { shared } from "./css";

const AXES = ["x", "y", "z"] as const;

@customElement("gs-clip")
export class Clip extends Panel {
  static override styles = [
    shared,
    css`
      .grid {
        display: grid;
        grid-template-columns: auto 1fr 1fr;
        gap: 6px 8px;
        align-items: center;
      }
    `,
  ];

  protected override render() {
    const { clip, map, component } = this.state;
    const unit = (map && derive.componentOf(map, component)?.metres_per_unit) ?? 1;
    if (!clip) return nothing;
    return html`<section class="card">
      <div class="row spread">
        <h3 id="title">Clip box, metres</h3>
        <button class="plain" @click=${() => actions.clip(false)}>Remove</button>
      </div>
      <div class="grid" role="group" aria-labelledby="title">
        ${AXES.map(
          (name, axis) =>
            html`<span class="muted">${name}</span> ${([0, 1] as const).map(
                (corner) =>
                  html`<input
                    type="number"
                    step="0.1"
                    aria-label="${corner ? "highest" : "lowest"} ${name}"
                    .value=${(clip[corner][axis as 0 | 1 | 2] * unit).toFixed(2)}
                    @change=${(event: Event) =>
                      actions.clipFace(
                        corner,
                        axis as 0 | 1 | 2,
                        (event.target as HTMLInputElement).valueAsNumber / unit,
                      )}
                  />`,
              )}`,
        )}
      </div>
    </section>`;
  }
}
