// The pins of the open scan: in the panel, on the picture, in the address, and at the node.

import type { Pane } from './pane.ts';
import type { OpenSidecar } from './sidecar.ts';
import { PinsPanel } from './ui/pins_panel.ts';
import type { Pin } from './url_state.ts';

export class Pins {
  readonly panel: PinsPanel;
  list: Pin[] = [];

  /** changed: the address shall say so. */
  constructor(private readonly pane: Pane, private readonly sidecar: OpenSidecar, private readonly changed: () => void) {
    this.panel = new PinsPanel((pin) => this.keep([...this.list, pin]), (index) => this.keep(this.list.filter((_, at) => at !== index)),
      (pin) => this.goTo(pin));
  }

  show(list: Pin[]): void {
    this.list = list;
    this.panel.show(list, this.sidecar.isKept);
    this.pane.marks.setPins(list);
  }

  /** Whether who looks at the page may set and remove pins. */
  allow(allowed: boolean): void {
    this.panel.allow(allowed);
    this.show(this.list);
  }

  private keep(pins: Pin[]): void {
    this.show(pins);
    this.changed();
    void this.sidecar.save({ pins }, false);
  }

  private goTo(pin: Pin): void {
    if (!this.pane.info) return;
    this.pane.stage.face(pin);
    this.changed();
  }
}
