/** The angle that the camera looks at first: where the front of a person stands. */
export const FACING_RAD = 0;
