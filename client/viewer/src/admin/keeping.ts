import { h, refill } from '../ui/dom.ts';
import type { Words } from './admin.ts';
import type { Upkeep } from './answers.ts';

/** How the node is: health and why, scanner, disk, certificate, retention, version. */
export class Keeping {
  readonly element: HTMLElement;
  private readonly state = h('p', { role: 'status' });
  private readonly reasons = h('ul', { class: 'complaints' });
  private readonly facts = h('dl');

  constructor(private readonly words: Words) {
    this.element = h('section', { 'aria-labelledby': 'admin-health' }, h('h3', { id: 'admin-health' }, words.admin.health), this.state,
      this.reasons, this.facts);
  }

  show(upkeep: Upkeep): void {
    const { admin, scanner } = this.words;
    const state = admin.states[upkeep.status] ?? upkeep.status;
    if (this.state.textContent !== state) this.state.textContent = state; // said aloud only when it changes
    this.state.dataset['state'] = upkeep.status;
    refill(this.reasons, ...upkeep.reasons.map((why) => h('li', {}, why)));
    const { phase, progress } = upkeep.capture;
    const sweeping = phase === 'sweeping' ? ` ${Math.round(100 * (progress ?? 0))} %` : '';
    const { certificate } = upkeep;
    const facts: [string, string | Node][] = [
      [admin.scanner, `${scanner.phases[phase] ?? phase}${sweeping}`],
      [admin.disk, admin.free(upkeep.disk.freeBytes, upkeep.disk.sizeBytes)],
      [admin.kept, admin.counts(upkeep.scans, upkeep.interrupted)],
      [admin.retention, admin.rules(upkeep.retention.maxAgeDays, upkeep.retention.maxGb)],
      [admin.viewers, String(upkeep.streams)],
      [admin.certificate, certificate ? admin.valid(certificate.ends, certificate.own) : admin.noLogins],
      ...(certificate ? [[admin.fingerprint, h('code', {}, admin.pairs(certificate.fingerprint))] as [string, Node]] : []),
      [admin.version, admin.since(upkeep.version, upkeep.started)],
    ];
    refill(this.facts, ...facts.flatMap(([term, fact]) => [h('dt', {}, term), h('dd', {}, fact)]));
  }
}
