// An answer of the server while it is on its way, when it failed, and when it is there.
import { html } from "lit";
import type { TemplateResult } from "lit";
import type { Resource } from "../resources";

export function waiting<T>(
  resource: Resource<T>,
  doing: string,
  again: () => void,
  ready: (value: T) => TemplateResult,
): TemplateResult {
  if (resource.status === "ready") return ready(resource.value);
  if (resource.status === "loading") return html`<p class="waiting" role="status">${doing}</p>`;
  return html`<div class="failed stack" role="alert">
    <p>${resource.error}</p>
    <p><button @click=${again}>Ask again</button></p>
  </div>`;
}
