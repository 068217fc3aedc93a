/** What a node sent makes no sense: whoever reads it ends the stream. */
export class RemoteWireError extends Error {
  override name = 'RemoteWireError';
}

/** A refinement was planned over other holdings than ours: state them, and go on. */
export class HoldingsDiffer extends Error {
  override name = 'HoldingsDiffer';
}
