// A person's word on an edge or a change: a note, and confirm, reject or withdraw.
import { css, html, nothing } from "lit";
import { customElement, property } from "lit/decorators.js";
import * as actions from "../actions";
import type { Verdict } from "../actions";
import type { Selection } from "../state";
import { Panel } from "./base";
import { shared } from "./css";
import { icon } from "./icons";

/** Of details that end with a word: it keeps to the bottom, however little stands above it. */
export const verdictBelow = css`
  :host {
    display: flex;
    flex-direction: column;
    min-height: 100%;
  }
  .body {
    flex: 1;
  }
`;

@customElement("gs-verdict")
export class VerdictForm extends Panel {
  static override styles = [
    shared,
    css`
      :host {
        position: sticky;
        bottom: 0;
        background: var(--surface);
        border-top: 1px solid var(--line);
        padding: 10px 16px;
        z-index: 1;
      }
      .buttons {
        display: grid;
        grid-auto-flow: column;
        grid-auto-columns: 1fr;
        gap: 8px;
        margin-top: 8px;
      }
      textarea {
        display: block;
        min-height: var(--target);
        height: calc(var(--target) + 8px);
      }
      @media (max-width: 759px) {
        :host {
          padding: 8px 14px;
        }
        form {
          display: flex;
          gap: 6px;
        }
        textarea {
          height: var(--target);
          min-width: 0;
          resize: none;
          white-space: nowrap;
        }
        .buttons {
          margin: 0;
          gap: 6px;
          flex: none;
        }
        .buttons button {
          width: 44px;
          padding: 0;
        }
        .buttons button span {
          position: absolute;
          clip-path: inset(50%);
        }
      }
    `,
  ];

  @property({ attribute: false }) of: Selection | null = null;
  @property() said: "confirm" | "reject" | null = null;
  @property() unconfirmable = ""; // why it cannot be confirmed; empty where it can
  @property() note = ""; // of the standing review

  // What was typed is kept by what it is about, so that nothing is lost by looking elsewhere meanwhile.
  private static readonly typed = new Map<string, string>();

  protected override render() {
    const { state } = this;
    if (!this.of) return nothing;
    if (!actions.mayAct(state))
      return html`<p class="muted small">
        ${this.note ? html`Note of the review: ${this.note}.` : nothing} This page only shows the map: reviewing needs
        <kbd>gsmap view MAP</kbd>.
      </p>`;
    const isBusy = state.busy !== null;
    const button = (verdict: Verdict, label: string, sign: "check" | "cross" | "undo", key: string) =>
      html`<button
        type="button"
        id=${verdict}
        title="${label} (${key})"
        aria-pressed=${verdict === "withdraw" ? nothing : this.said === verdict}
        ?disabled=${isBusy || (verdict === "withdraw" && !this.said)}
        @click=${() => void this.send(verdict)}
      >
        ${icon(sign)} <span>${label}</span>
      </button>`;
    return html`${this.unconfirmable ? html`<p class="muted small">${this.unconfirmable}</p>` : nothing}
      ${
        this.of.kind === "edge" && this.said && state.map?.stale
          ? html`<p class="muted small">The review takes effect with Optimize now.</p>`
          : nothing
      }
      <form @submit=${(event: Event) => event.preventDefault()}>
        <textarea
          id="note"
          rows="1"
          maxlength="500"
          aria-label="Note to the review"
          placeholder=${this.note ? `Note so far: ${this.note}` : "Note: why (optional)"}
          .value=${VerdictForm.typed.get(this.of.key) ?? ""}
          @input=${this.type}
        ></textarea>
        <div class="buttons">
          ${this.unconfirmable ? nothing : button("confirm", "Confirm", "check", "c")}
          ${button("reject", "Reject", "cross", "r")} ${button("withdraw", "Withdraw", "undo", "t")}
        </div>
      </form>`;
  }

  focusNote(): void {
    this.renderRoot.querySelector("textarea")?.focus();
  }

  private type(event: Event): void {
    if (this.of) VerdictForm.typed.set(this.of.key, (event.target as HTMLTextAreaElement).value);
  }

  async send(verdict: Verdict): Promise<void> {
    const { of } = this;
    if (!of) return;
    if (verdict === "confirm" && this.unconfirmable) {
      actions.say(this.unconfirmable);
      return;
    }
    if (await actions.review(of, verdict, VerdictForm.typed.get(of.key) ?? "")) {
      VerdictForm.typed.delete(of.key);
      this.requestUpdate();
    }
  }
}
