// Answers of the server that are kept while the map is the same: asked once, shown as they come, asked again on request.
import { Gone } from "./api";
import { page } from "./state";

export type Resource<T> =
  { status: "loading" } | { status: "ready"; value: T } | { status: "failed"; error: string; gone: boolean };

export class Resources<T> {
  private readonly kept = new Map<string, Resource<T>>();
  private readonly old = new Set<string>();

  constructor(private readonly ask: (key: string) => Promise<T>) {}

  /** What is known of `key`; asks for it where nothing is. */
  get(key: string): Resource<T> {
    const found = this.kept.get(key);
    if (found && !this.old.delete(key)) return found;
    const resource: Resource<T> = found ?? { status: "loading" };
    this.kept.set(key, resource);
    const put = (made: Resource<T>) => {
      if (this.kept.get(key) !== resource) return; // forgotten or asked again meanwhile
      this.kept.set(key, made);
      page.tell();
    };
    this.ask(key).then(
      (value) => put({ status: "ready", value }),
      (error: unknown) => {
        const gone = error instanceof Gone;
        put({ status: "failed", error: error instanceof Error ? error.message : String(error), gone });
        if (gone) page.set({ gone: true });
      },
    );
    return resource;
  }

  /** What is known is shown until a new answer is there, which is asked for when it is next looked at. */
  refresh(): void {
    for (const [key, resource] of this.kept) if (resource.status === "ready") this.old.add(key);
  }

  forget(key?: string): void {
    if (key === undefined) this.kept.clear();
    else this.kept.delete(key);
    page.tell();
  }

  /** So that what failed for want of a server is asked again when it is back. */
  forgetFailed(): void {
    for (const [key, resource] of this.kept) if (resource.status === "failed") this.kept.delete(key);
  }
}
