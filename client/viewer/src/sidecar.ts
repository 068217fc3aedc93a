// What people say of the scan that is open: read from the node, changed there, whoever else changes it meanwhile.

import { changeSidecar, readSidecar, Refused } from './api.ts';
import type { Changes, Sidecar } from './api.ts';
import { strings } from './strings.ts';

export interface SidecarEvents {
  say(text: string): void;
  /** It is known now; null where the node keeps no such thing. */
  known(scan: string, sidecar: Sidecar | null): void;
}

export class OpenSidecar {
  private scan: string | null = null;
  private sidecar: Sidecar | null = null;

  constructor(private readonly events: SidecarEvents) {}

  /** Whether the node keeps what is said. */
  get isKept(): boolean {
    return this.sidecar !== null;
  }

  /** Another scan is open. */
  async open(scan: string): Promise<void> {
    if (this.scan !== scan) this.sidecar = null;
    this.scan = scan;
    await this.refresh();
  }

  close(): void {
    this.scan = this.sidecar = null;
  }

  /** Change some of it; where somebody else was faster, show what they said instead. */
  async save(changes: Changes, aloud: boolean): Promise<void> {
    const { scan, sidecar } = this;
    if (!scan || !sidecar) return;
    try {
      this.take(scan, await changeSidecar(scan, sidecar.revision, changes));
      if (aloud) this.events.say(strings.about.saved);
    } catch (error) {
      const conflict = error instanceof Refused && (error.status === 409 || error.status === 412);
      this.events.say(conflict ? strings.pins.conflict : strings.failed((error as Error).message));
      await this.refresh();
    }
  }

  private async refresh(): Promise<void> {
    const { scan } = this;
    if (!scan) return;
    try {
      this.take(scan, await readSidecar(scan));
    } catch (error) {
      this.events.say(strings.failed((error as Error).message));
    }
  }

  private take(scan: string, sidecar: Sidecar | null): void {
    if (scan !== this.scan) return;
    this.sidecar = sidecar;
    this.events.known(scan, sidecar);
  }
}
