-- What a list of jobs shows without their specs, which may be long; and jobs by their end, for those that are forgotten.
ALTER TABLE job ADD COLUMN name TEXT NOT NULL DEFAULT '';
CREATE INDEX job_by_name ON job (name);
CREATE INDEX job_by_end ON job (ended_ms) WHERE state <> 0;

-- The life of a coordinator that has the catalog: one row, written when it begins. `room` shows that there is some.
CREATE TABLE life (
    key   INTEGER PRIMARY KEY CHECK (key = 1),
    instance BLOB NOT NULL,
    room  BLOB NOT NULL
) STRICT;
