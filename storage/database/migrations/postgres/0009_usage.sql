-- What jobs consumed, summed by day (since 1970-01-01, UTC), user and project. It outlives the jobs. Each instance has rows of
-- its own, so that no instance waits for another one. core_ms: milliseconds times the cores that a task used.
CREATE TABLE usage (
    day      BIGINT NOT NULL,
    username TEXT NOT NULL,
    project  TEXT NOT NULL,
    instance UUID NOT NULL,
    tasks    BIGINT NOT NULL,
    failures BIGINT NOT NULL,
    core_ms  BIGINT NOT NULL,
    bytes    BIGINT NOT NULL,
    PRIMARY KEY (day, username, project, instance)
) WITH (fillfactor = 50);
