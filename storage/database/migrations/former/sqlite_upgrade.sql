-- Brings a catalog that began with `sqlite_0001_init.sql` to the schema of today's `sqlite/0001_init.sql`.
ALTER TABLE job ADD COLUMN superseded INTEGER NOT NULL DEFAULT 0;
DROP INDEX job_live;
CREATE UNIQUE INDEX job_live ON job (spec_hash) WHERE state <= 1 AND superseded = 0;
ALTER TABLE output ADD COLUMN checked INTEGER NOT NULL DEFAULT 0;
