"""Loop closing: places seen before, their verification, and the correction of drift."""
