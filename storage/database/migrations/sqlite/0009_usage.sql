-- What jobs consumed, summed by day (since 1970-01-01, UTC), user and project. It outlives the jobs. Each instance has rows of
-- its own, so that no instance waits for another one. core_ms: milliseconds times the cores that a task used.
CREATE TABLE usage (
    day      INTEGER NOT NULL,
    username TEXT NOT NULL,
    project  TEXT NOT NULL,
    instance BLOB NOT NULL,
    tasks    INTEGER NOT NULL,
    failures INTEGER NOT NULL,
    core_ms  INTEGER NOT NULL,
    bytes    INTEGER NOT NULL,
    PRIMARY KEY (day, username, project, instance)
) STRICT, WITHOUT ROWID;
