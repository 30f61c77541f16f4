// What every element of the page has in common.
import { LitElement, noChange } from "lit";
import { directive, Directive, PartType } from "lit/directive.js";
import type { ElementPart, PartInfo } from "lit/directive.js";
import { page } from "../state";
import type { State } from "../state";
import { shared } from "./css";

/** An element that is drawn again whenever the state changes. */
export class Panel extends LitElement {
  static override styles = [shared];
  private end: (() => void) | null = null;

  protected get state(): State {
    return page.state;
  }

  override connectedCallback(): void {
    super.connectedCallback();
    this.end = page.listen(() => this.requestUpdate());
  }

  override disconnectedCallback(): void {
    super.disconnectedCallback();
    this.end?.();
  }
}

/** An element over the 3D view, told after every picture. */
export abstract class CanvasPanel extends Panel {
  private canvas: HTMLElement | null = null;

  protected abstract readonly drawn: () => void;

  override connectedCallback(): void {
    super.connectedCallback();
    this.canvas = document.getElementById("canvas");
    this.canvas?.addEventListener("drawn", this.drawn);
  }

  override disconnectedCallback(): void {
    super.disconnectedCallback();
    this.canvas?.removeEventListener("drawn", this.drawn);
  }
}

/** `<div ${vars({ "--at": "50%" })}>`: set through the object model, as the page's CSP has no inline styles. */
class Vars extends Directive {
  constructor(part: PartInfo) {
    super(part);
    if (part.type !== PartType.ELEMENT) throw new Error("vars() stands by itself in a tag");
  }

  override render(values: Record<string, string>): unknown {
    void values; // update() sets them; this gives its type
    return noChange;
  }

  override update(part: ElementPart, [values]: [Record<string, string>]): unknown {
    const { style } = part.element as HTMLElement;
    for (const [name, value] of Object.entries(values)) style.setProperty(name, value);
    return noChange;
  }
}

export const vars = directive(Vars);
