"""Places of tool, sensor and object, the path around an object, and the last axis of an arm of four axes."""
