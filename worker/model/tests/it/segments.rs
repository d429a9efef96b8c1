//! Gradients computed segment by segment are the same, to the bit, as those computed at once.

use burn::tensor::Device;
use picofarm_model::{
    input::Target,
    net::{Architecture, Net, NetSpec, StemForm, Swin},
    train::{
        Gradients,
        group::{Blocks, Part, add_values, share},
    },
    trial::Trial,
};

fn net(architecture: Architecture) -> NetSpec {
    NetSpec {
        architecture,
        width: 8,
        levels: 3,
        time: 8,
        swin: Swin {
            groups: 1,
            depth: 2,
            heads: 2,
            window: 4,
        },
        ..NetSpec::released(12, 12, 1)
    }
}

fn networks() -> Vec<NetSpec> {
    let of = |architecture| net(architecture);
    let stem = |stem_form| NetSpec {
        stem: 6,
        stem_form,
        ..net(Architecture::Unet2d)
    };
    let frozen = |architecture| NetSpec {
        frozen: true,
        ..net(architecture)
    };
    let two_levels = NetSpec {
        levels: 2,
        ..net(Architecture::Unet2d)
    };
    vec![
        of(Architecture::Unet2d),
        of(Architecture::Unet25d),
        of(Architecture::Swinir),
        of(Architecture::Embeddings),
        of(Architecture::Nlost),
        stem(StemForm::Block),
        stem(StemForm::Linear),
        two_levels,
        frozen(Architecture::Unet2d),
        frozen(Architecture::Unet25d),
    ]
}

fn trial(net: NetSpec, seed: u64) -> Trial {
    Trial {
        target: Target::Shadow,
        net,
        batch: 2,
        side: 32,
        learning_rate: 1e-2,
        decay: 1e-3,
        seed,
    }
}

/// Returns the parts that `processes` compute of a step of four batches, added up as a group does.
fn together(net: &NetSpec, processes: usize, device: &Device) -> Vec<Part> {
    let count = Net::new(net.clone()).unwrap().segments().len();
    let mut sums: Vec<(usize, Blocks<Vec<f32>>)> = vec![(0, Blocks::default()); count];
    let mut moved = Vec::new();
    for which in 0..processes {
        let (learner, _) = trial(net.clone(), 1).begin(device).unwrap();
        let (mut sum, mut last) = (Gradients::default(), None);
        let share = share(4, which, processes);
        for at in share.clone() {
            let (_, batch) = trial(net.clone(), at as u64).begin(device).unwrap();
            let batch = learner.bring(batch);
            match at + 1 == share.end {
                true => last = Some((at, batch)),
                false => learner.add(&mut sum, at, batch).unwrap(),
            }
        }
        let mut parts = Vec::new();
        learner
            .parts(sum, last, &mut |part| parts.push(part))
            .unwrap();
        assert_eq!(parts.len(), count);
        for (at, part) in parts.into_iter().enumerate() {
            assert!(at + 1 == count || part.moved.is_empty());
            moved.extend(part.moved);
            sums[at].0 = part.len;
            for block in part.blocks.as_slice() {
                sums[at]
                    .1
                    .push(block.clone(), &mut |a, b| add_values(a, &b));
            }
        }
    }
    let parts = sums.into_iter().enumerate();
    parts
        .map(|(at, (len, blocks))| Part {
            len,
            blocks,
            moved: match at + 1 == count {
                true => std::mem::take(&mut moved),
                false => Vec::new(),
            },
        })
        .collect()
}

#[test]
fn steps_in_segments_of_any_number_of_processes_move_every_number_as_whole_ones_do() {
    let device = Device::flex();
    for net in networks() {
        let pace = trial(net.clone(), 1).pace();
        let (mut whole, _) = trial(net.clone(), 1).begin(&device).unwrap();
        let batches = (0..4).map(|at| trial(net.clone(), at).begin(&device).unwrap().1);
        let loss = whole.step(batches.collect(), pace).unwrap();
        for processes in [1, 2, 3, 5] {
            let (mut learner, _) = trial(net.clone(), 1).begin(&device).unwrap();
            let parts = together(&net, processes, &device);
            let sum = learner.gradients_of(parts, 4).unwrap();
            assert_eq!(learner.finish(sum, 4, pace).unwrap(), loss, "{net:?}");
            let (found, expected) = (learner.parameters(), whole.parameters());
            assert!(found.to_named() == expected.to_named(), "{net:?}");
        }
    }
}

#[test]
fn unets_have_three_segments_that_hold_every_parameter_once() {
    for spec in networks() {
        let net = Net::new(spec.clone()).unwrap();
        let mut end = 0;
        for segment in net.segments() {
            assert_eq!(segment.start, end);
            end = segment.end;
        }
        assert_eq!(end, net.declared().len());
        let unet = matches!(
            spec.architecture,
            Architecture::Unet2d | Architecture::Unet25d
        );
        let expected = if unet && !spec.frozen { 3 } else { 1 };
        assert_eq!(net.segments().len(), expected, "{spec:?}");
    }
    // In the released network, an eighth of the gradients remains for the end, when no computation
    // hides their transfer.
    let released = Net::new(NetSpec::released(637, 0, 1)).unwrap();
    let values = |which: usize| -> usize {
        let of = released.declared()[released.segments()[which].clone()].iter();
        of.map(|d| d.len()).sum()
    };
    let all: usize = (0..3).map(values).sum();
    assert!(values(0) * 8 < all, "{} of {all}", values(0));
}

#[test]
fn parts_that_are_none_of_a_step_are_refused() {
    let device = Device::flex();
    let net = net(Architecture::Unet2d);
    let (learner, _) = trial(net.clone(), 1).begin(&device).unwrap();
    let parts = || together(&net, 2, &device);
    let refused = |parts: Vec<Part>, what: &str| {
        let error = learner.gradients_of(parts, 4).map(|_| ()).unwrap_err();
        assert!(error.to_string().contains(what), "{error}");
    };
    refused(parts().split_off(1), "segments have 2 values, not 3");
    let mut short = parts();
    short[1].blocks = std::mem::take(&mut short[1].blocks).map(|mut values| {
        values.pop();
        values
    });
    refused(short, "gradients have");
    let mut swapped = parts();
    swapped.swap(0, 2);
    refused(swapped, "gradients have");
    let mut moved = parts();
    moved[2].moved[0].1.push(0.0);
    refused(moved, "running statistics have");
}
