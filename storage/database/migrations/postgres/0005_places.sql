-- Folders of stores into which jobs write, and whose they are: the first submitter's. `place` is a path or URL that ends with
-- a slash. `record`: a named record in a data set, which may be another user's. `job` is the owner's latest that writes there.
CREATE TABLE owned_place (
    place     TEXT COLLATE "C" NOT NULL,
    record    BOOLEAN NOT NULL,
    username  TEXT NOT NULL,
    project   TEXT NOT NULL,
    job       UUID NOT NULL,
    PRIMARY KEY (place, record)
);

-- What earlier jobs wrote belongs to their submitters.
INSERT INTO owned_place (place, record, username, project, job)
SELECT rtrim(CASE WHEN store LIKE 'file:///%' THEN substr(store, 8) ELSE store END, '/') || '/'
           || CASE WHEN dataset LIKE '/%' THEN '' ELSE dataset || '/' END,
       CASE WHEN dataset LIKE '%/split/%' THEN TRUE ELSE FALSE END,
       job.username, job.project, job.id
FROM stage JOIN result_set ON result_set.key = stage.result_set JOIN job ON job.key = stage.job
WHERE job.username NOT IN ('', 'anyone')
    AND dataset NOT LIKE '%/evaluate' AND dataset NOT LIKE '%/shards' AND dataset NOT LIKE '%/verify'
    AND dataset NOT LIKE '%/parts'
ORDER BY job.key
ON CONFLICT DO NOTHING;
