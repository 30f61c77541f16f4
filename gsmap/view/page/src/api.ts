// Every request that the panels make. What comes back is data of a map that may be anybody's: shapes are checked where
// the page would break, addresses wherever one is loaded, and nothing is ever taken for HTML.
import type {
  Actions,
  EdgeDetail,
  FloorPlan,
  GraphEntry,
  MapState,
  MapSummary,
  PlaceHistory,
  RevisionPoses,
} from "./contract";

/** Nobody answered: the server was ended, or the way to it is cut. */
export class Gone extends Error {}

/** The server answered and refused; the message is its own. */
export class Refused extends Error {
  constructor(
    message: string,
    readonly status: number,
  ) {
    super(message);
  }
}

const RELATIVE = /^(?!.*\.\.)[A-Za-z0-9_-][A-Za-z0-9_.@+-]*(\/[A-Za-z0-9_-][A-Za-z0-9_.@+-]*)*$/;

/** An address below the page itself, or null: no scheme, no host, no way up, no query. */
export function relative(uri: string | null | undefined): string | null {
  return typeof uri === "string" && uri.length < 300 && RELATIVE.test(uri) ? uri : null;
}

export async function getMap(): Promise<MapSummary> {
  const map = await get<MapSummary>("map.json");
  if (map.schema !== 1)
    throw new Refused(`this page reads maps of schema 1, and was sent schema ${String(map.schema)}: reload it`, 0);
  for (const part of ["components", "scenes", "edges", "revisions", "changes", "photos"] as const)
    if (!Array.isArray(map[part])) throw new Refused(`map.json lacks "${part}": gsmap and its page differ`, 0);
  return map;
}

export const getState = () => get<MapState>("state.json");
export const getRevision = (uri: string) => get<RevisionPoses>(below(uri));
export const getEdge = (uri: string) => get<EdgeDetail>(below(uri));
export const getPlan = (uri: string) => get<FloorPlan>(below(uri));
export const getGraph = (uri: string) => get<GraphEntry>(below(uri));
export const getHistory = (uri: string, at: string, component: number) =>
  get<PlaceHistory>(`${below(uri)}?at=${at}&component=${component}`);

function below(uri: string): string {
  const found = relative(uri);
  if (found === null) throw new Refused(`the map names an address outside this page: ${uri.slice(0, 200)}`, 0);
  return found;
}

/** Does one action; gives the map as it is afterwards. */
export async function act<Name extends keyof Actions>(name: Name, body: Actions[Name]): Promise<MapSummary> {
  const said = await request(`actions/${name}`, {
    method: "POST",
    headers: { "Content-Type": "application/json" },
    body: JSON.stringify(body),
  });
  return (said as { map: MapSummary }).map;
}

const get = async <T>(path: string): Promise<T> => (await request(path, { cache: "no-cache" })) as T;

async function request(path: string, options: RequestInit): Promise<unknown> {
  let answer: Response;
  try {
    answer = await fetch(path, options);
  } catch {
    throw new Gone("gsmap view does not answer");
  }
  if (!answer.ok) {
    const said = (await answer.json().catch(() => null)) as { error?: unknown } | null;
    throw new Refused(typeof said?.error === "string" ? said.error : explained(path, answer.status), answer.status);
  }
  try {
    return await answer.json();
  } catch {
    throw new Refused(`${path} is not JSON: the answer was cut, or this is not gsmap's server`, answer.status);
  }
}

function explained(path: string, status: number): string {
  if (status === 403) return "This page belongs to a gsmap view that has ended. Open the address that it prints now.";
  if (status === 404) return `${path} is not part of this page`;
  return `${path}: the server answered with ${status}`;
}
