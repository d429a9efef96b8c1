//! Commented job files as a starting point, one for each kind of job.

use crate::args::JobKind;

/// Returns a job file as a starting point.
pub fn template(kind: JobKind) -> String {
    let scenes = match kind {
        JobKind::Graph => return graph(),
        JobKind::Train => return training(),
        JobKind::Sweep => return sweep(),
        JobKind::Furnished => {
            "kind = \"furnished\"        # furnished rooms; also: primitive, desktop, files\n\
             count = 8\n\
             seed = 1                  # scene i derives its own seed from (seed, i)\n\
             spots = 25                # laser spots: a grid of 1, 4, 16, 25 or 100; or { random = 16 } or { at = [[0.5, 0.5]] }\n\
             fov_deg = 90.0            # horizontal field of view\n\
             assets = \"auto\"           # sweethome3d if installed, otherwise parametric\n\
             min_specular = 1          # least number of mirrors in a room\n\
             floor_plan = \"box\"        # varied: also L-shaped rooms, open doors and glazed windows\n"
        }
        JobKind::Primitive => {
            "kind = \"primitive\"        # a cube, a cylinder and a mirror in a room\n\
             count = 8\n\
             seed = 1                  # scene i derives its own seed from (seed, i)\n\
             spots = 25                # laser spots: a grid of 1, 4, 16, 25 or 100; or { random = 16 } or { at = [[0.5, 0.5]] }\n\
             fov_deg = 90.0            # horizontal field of view; jittered by scene\n"
        }
        JobKind::Desktop => {
            "kind = \"desktop\"          # a box on a desk, as in the paper's laboratory: a cube, a cylinder of one inch, a mirror\n\
             count = 8\n\
             seed = 1                  # scene i derives its own seed from (seed, i)\n\
             spots = 16                # laser spots: a grid of 1, 4, 16, 25 or 100; or { random = 16 } or { at = [[0.5, 0.5]] }\n\
             fov_deg = 46.0            # horizontal field of view; jittered by scene\n\
             # laser_m = [0.05, 0.0, 0.0]   # laser relative to the camera: x right, y down, z forward\n\
             # [scenes.rooms]          # ranges, with their defaults; kind = \"primitive\" has them too, for living rooms\n\
             # scale = [0.22, 0.34]    # of 1, a room is 3.6 m wide and deep, each ± 10 %, and 2.6 m high\n\
             # depth_m = [0.3, 1.4]    # of the view; a view outside this range is drawn again\n\
             # fov_jitter_deg = 3.0\n\
             # cube = { width_m = [0.06, 0.16], height_m = [0.06, 0.2] }\n\
             # cylinder = { width_m = [0.0254, 0.0254], height_m = [0.1, 0.3] }\n\
             # mirror = { width_m = [0.12, 0.3], height_m = [0.12, 0.3] }\n\
             # mirror_wall = \"back\"    # or: any, none\n\
             # mirror_from_m = [0.05, 0.2]   # height of its lower edge\n"
        }
        JobKind::Files => {
            "kind = \"files\"            # .glb, .gltf, .xml, .json, .obj, .ply or .stl, one task each\n\
             files = [\"scene.glb\"]     # relative to this file; also patterns such as \"models/*.glb\", and folders\n\
             # spots = 25              # for files without a laser; omitted: 25, spread over what the camera sees\n\
             # replace_laser = true    # use the spots instead of the files' lasers\n\
             # camera = \"0\"            # the file's camera by name or number\n\
             # look_from = [0.0, 1.5, 4.0]   # or a view of your own, metres; also: look_at, up, fov_deg\n\
             # unit = \"mm\"             # unit of the files: m, cm, mm, in or ft\n"
        }
    };
    format!(
        "# A picofarm job. `picofarm job plan FILE` shows what it would run; `picofarm job submit FILE` runs it.\n\
         name = \"rooms\"\n\
         # parts = 8               # divides each scene among this many tasks; the bytes are the same\n\n\
         [scenes]\n{scenes}\n\
         [render]\n\
         resolution = 256          # pixels, square; or width and height: \"320x240\"\n\
         gate_start_m = 1.0        # start of the time gate, metres of optical path\n\
         bin_width_m = 0.0384      # metres of optical path (128 ps)\n\
         bins = 637\n\
         samples = 32              # camera paths per pixel; or: error = \"10%\"\n\
         max_bounces = 0           # 0 = until the gate ends\n\
         # subsets = [4, 25]       # with spots = 100: also histograms of these subsets, from the same rays\n\
         # per_spot = true         # also a histogram of each spot, from the same rays: spots times the size\n\
         # strategy = {{ path_reuse = 1, mirror_images = false }}  # techniques, chosen by hand\n\
         # beam = {{ diameter_mm = 4, divergence_mrad = 1 }}  # width of the laser's beams (1/e²); default: none\n\
         # fill_factor = 0.3       # share of each pixel's area that is sensitive\n\
         # wavelengths_nm = [905]  # of the laser; default: that of the scenes' reflectances\n\n\
         [output]\n\
         store = \"picofarm-data/store\"   # a folder that every worker can reach, or s3://bucket/prefix\n\
         dataset = \"rooms\"\n\
         profile = \"sqrt-u16\"            # or: auto (as coarse as render.error allows), balanced, coarse, plain-f32, lossless\n\n\
         [limits]\n\
         max_failures = 3          # failures of a task before it is given up\n\
         max_crashes = 3           # losses of its worker before a task is given up\n\
         # max_interruptions = 20  # hand-backs by workers before a task is given up\n\
         # max_workers = 8         # most workers that run the job at a time\n\
         # deadline = \"2027-01-31T18:00:00Z\"   # unfinished tasks are then cancelled\n\n\
         # [resources]             # requirements of a worker\n\
         # cores = 8\n\
         # memory_gib = 16\n\
         # labels = [\"fast\"]       # of `picofarm worker --label`\n"
    )
}

/// Returns a job of several stages.
fn graph() -> String {
    "# A picofarm job of several stages. `picofarm job plan FILE` shows what it would run.\n\
     name = \"noisy rooms\"\n\
     priority = 0              # jobs of a higher priority get workers first\n\n\
     [[stage]]                 # kind = \"render\" is the default\n\
     name = \"render\"\n\
     scenes = { kind = \"primitive\", count = 8, seed = 1, spots = 25 }\n\
     render = { resolution = 64, samples = 16 }\n\
     output = { store = \"picofarm-data/store\", dataset = \"clean\" }\n\n\
     [[stage]]                 # one stage for each value of the matrix, which replaces {dark}\n\
     name = \"noise\"\n\
     kind = \"reprocess\"\n\
     source = \"render\"         # a stage that makes a data set, or { store = \"…\", dataset = \"…\" }\n\
     matrix = { dark = [0.0, 0.5] }\n\
     reprocess = { seed = 1, sensor = { dark_per_bin = \"{dark}\" } }\n\
     output = { store = \"picofarm-data/store\", dataset = \"noisy-{dark}\", profile = \"counts-u16\" }\n\n\
     [[stage]]\n\
     name = \"split\"\n\
     kind = \"split\"\n\
     source = \"noise[0.5]\"     # starts when that stage is done\n\
     split = { fractions = [0.5, 0.25, 0.25] }\n\n\
     [[stage]]\n\
     name = \"export\"\n\
     kind = \"export\"\n\
     source = \"noise[0.5]\"\n\
     needs = [\"split\"]\n\
     export = { dest = \"picofarm-data/export\", scenes = \"split:train\" }\n"
        .to_owned()
}

/// Returns a job that makes its data and trains on them: minutes on a laptop.
fn training() -> String {
    "# A picofarm job that renders small rooms and trains networks on them: an hour on two cores, without a GPU. The same file\n\
     # with furnished rooms, resolution = 256, [scenes] count = 97432 and the defaults of `net` and `optimise` is the paper's.\n\
     name = \"learning\"\n\n\
     [limits]\n\
     max_crashes = 100         # a training continues from its last checkpoint when its worker is lost\n\n\
     [[stage]]\n\
     name = \"render\"\n\
     scenes = { kind = \"primitive\", count = 120, seed = 1, spots = 25 }\n\
     render = { resolution = 32, samples = 8, bins = 160, bin_width_m = 0.1536 }\n\
     output = { store = \"picofarm-data/store\", dataset = \"small-rooms\" }\n\n\
     [[stage]]\n\
     name = \"split\"\n\
     kind = \"split\"\n\
     source = \"render\"\n\
     split = { fractions = [0.8, 0.1, 0.1] }\n\n\
     [[stage]]                 # depth, from the times of two-bounce light\n\
     name = \"tof\"\n\
     kind = \"train\"\n\
     source = \"render\"         # also needs the split \"default\" of its data set\n\
     # resources = { gpus = 1 } # only on workers with a graphics processor\n\
     [stage.train]\n\
     target = \"tof\"              # or: shadow, specular\n\
     model = \"tof\"             # name in the store: `picofarm model show STORE tof`\n\
     # scenes = 64             # train on fewer scenes\n\
     # histogram = \"transient_4\"\n\
     input = { bins = 40 }     # sums of adjacent bins; 0 = all. normalise = \"minmax\" or \"log\"\n\
     net = { architecture = \"unet2d\", width = 16, levels = 3 }\n\
     optimise = { epochs = 30, batch = 8, learning_rate = 1e-2, schedule = \"onecycle\" }\n\
     seed = 1\n\
     checkpoint_minutes = 1.0  # most work that a lost worker costs\n\n\
     [[stage]]                 # predicted depth of every room\n\
     name = \"depths\"\n\
     kind = \"infer\"\n\
     source = \"render\"\n\
     infer = { models = [\"tof\"] }\n\
     output = { store = \"picofarm-data/store\", dataset = \"small-rooms-depths\" }\n\n\
     [[stage]]                 # which pixels each spot lights, with two-bounce times from that depth\n\
     name = \"shadow\"\n\
     kind = \"train\"\n\
     source = \"render\"\n\
     [stage.train]\n\
     target = \"shadow\"\n\
     model = \"shadow\"\n\
     shadow = { variant = \"concat\", times = \"depths\" }   # an infer stage, its folder, or truth\n\
     input = { bins = 40 }\n\
     net = { width = 16, levels = 3 }\n\
     optimise = { epochs = 30, batch = 8 }\n\n\
     [[stage]]                 # mirrors, from the frozen features of the depth network\n\
     name = \"mirrors\"\n\
     kind = \"train\"\n\
     source = \"render\"\n\
     [stage.train]\n\
     target = \"specular\"\n\
     model = \"mirrors\"\n\
     specular = { on = \"tof\" }\n\
     input = { bins = 40 }\n\
     net = { width = 16, levels = 3 }\n\
     optimise = { epochs = 30, batch = 8 }\n\n\
     [[stage]]\n\
     name = \"evaluate\"\n\
     kind = \"evaluate\"\n\
     source = \"render\"\n\
     evaluate = { models = [\"tof\", \"shadow\", \"mirrors\"], side = \"test\" }\n\n\
     [[stage]]                 # predictions for every room: depth, lit, specular\n\
     name = \"predict\"\n\
     kind = \"infer\"\n\
     source = \"render\"\n\
     infer = { models = [\"tof\", \"shadow\", \"mirrors\"] }   # at most one of each kind\n\
     output = { store = \"picofarm-data/store\", dataset = \"small-rooms-predicted\" }\n\n\
     [[stage]]                 # a page about them: picofarm-data/store/reports/learning/report.html\n\
     name = \"report\"\n\
     kind = \"report\"\n\
     report = { name = \"learning\", models = [\"tof\", \"shadow\", \"mirrors\"], pictures = 2 }\n"
        .to_owned()
}

fn sweep() -> String {
    "# A picofarm job that finds the settings with which a network learns best: half an hour on two cores.\n\
     # `picofarm sweep status STORE depth` shows the trials, `sweep report` writes a page about them, and\n\
     # `picofarm sweep extend FILE --trials 8` adds trials, chosen by their results.\n\
     name = \"sweep\"\n\n\
     [limits]\n\
     max_crashes = 100         # a trial continues from its last checkpoint when its worker is lost\n\n\
     [[stage]]\n\
     name = \"render\"\n\
     scenes = { kind = \"primitive\", count = 120, seed = 1, spots = 25 }\n\
     render = { resolution = 32, samples = 8, bins = 40, bin_width_m = 0.6144 }\n\
     output = { store = \"picofarm-data/store\", dataset = \"coarse-rooms\" }\n\n\
     [[stage]]\n\
     name = \"split\"\n\
     kind = \"split\"\n\
     source = \"render\"\n\
     split = { fractions = [0.8, 0.1, 0.1] }   # trials are compared on the validation scenes\n\n\
     [[stage]]\n\
     name = \"tof\"\n\
     kind = \"train\"\n\
     source = \"render\"\n\
     [stage.sweep]\n\
     trials = 27               # drawn at random; without it: every combination, if all parameters are lists\n\
     seed = 1                  # seed of the draws; later trials continue the sequence\n\
     stop = { halving = { first = 2, factor = 3 } }   # after 2, 6, 18 epochs the best third continues; also: median, hyperband\n\
     [stage.sweep.over]        # a parameter may appear anywhere in the stage as \"{name}\"\n\
     lr = { log = [1e-4, 1e-1] }           # or: range = [a, b], int = [a, b], or a list of values\n\
     decay = { log = [1e-5, 1e-1] }\n\
     width = [8, 12, 16]\n\
     [stage.train]\n\
     target = \"tof\"\n\
     model = \"depth\"           # trials are depth.0, depth.1, …; the best of them becomes depth\n\
     net = { width = \"{width}\", levels = 3 }\n\
     optimise = { epochs = 54, batch = 8, learning_rate = \"{lr}\", weight_decay = \"{decay}\" }\n\n\
     [[stage]]\n\
     name = \"evaluate\"\n\
     kind = \"evaluate\"\n\
     source = \"render\"\n\
     evaluate = { models = [\"tof\"], side = \"test\" }\n"
        .to_owned()
}
