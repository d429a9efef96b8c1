-- Brings a catalog that began with `postgres_0001_init.sql` to the schema of today's `postgres/0001_init.sql`.
ALTER TABLE house RENAME TO instance;
ALTER TABLE job ADD COLUMN superseded BOOLEAN NOT NULL DEFAULT FALSE;
DROP INDEX job_live;
CREATE UNIQUE INDEX job_live ON job (spec_hash) WHERE state <= 1 AND NOT superseded;
ALTER TABLE output ADD COLUMN checked BOOLEAN NOT NULL DEFAULT FALSE;
