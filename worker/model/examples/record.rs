fn main() {
    use picofarm_model::{input::Task, net::*, trial::Trial};
    let a: Vec<String> = std::env::args().collect();
    let task = match &*a[1] { "tof" => Task::Tof, "shadow" => Task::Shadow, _ => Task::Specular };
    let (dense, width, levels, side, batch): (usize,usize,usize,usize,usize) = (a[3].parse().unwrap(), a[4].parse().unwrap(), a[5].parse().unwrap(), a[6].parse().unwrap(), a[7].parse().unwrap());
    let one_hot = if task == Task::Shadow { dense } else { 0 };
    let net = NetSpec { dense, one_hot, width, levels, stem: a.get(8).map_or(0, |s| s.parse().unwrap()), frozen: a.get(9).is_some_and(|f| f == "frozen"), architecture: if a.get(9).is_some_and(|f| f == "25") { Architecture::Unet25d } else { Architecture::Unet2d }, time: dense * 2 / 3, ..NetSpec::released(dense, one_hot, 1) };
    let trial = Trial { task, net, batch, side, rate: 1e-3, decay: 1e-3, seed: 3 };
    std::fs::write(&a[2], trial.record(20, &burn::tensor::Device::flex()).unwrap()).unwrap();
}
