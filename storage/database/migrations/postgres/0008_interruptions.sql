-- Attempts at a task that a worker gave back half-way, and the longest attempt that did not end.
ALTER TABLE exception ADD COLUMN interruptions BIGINT NOT NULL DEFAULT 0;
ALTER TABLE exception ADD COLUMN longest_ms BIGINT NOT NULL DEFAULT 0;
