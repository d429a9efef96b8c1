//! A property that stateright's `eventually` cannot express, because it knows no fairness and may
//! miss cycles: a good state can be reached from every reachable state (AG EF in CTL). The whole
//! graph is explored and walked backwards from the good states.

use std::collections::HashMap;

use stateright::Model;

use crate::protocol_model::{model::Protocol, state::State};

/// Returns the reachable states from which no `good` state can be reached, and the number of
/// reachable states.
pub fn stranded(model: &Protocol, good: impl Fn(&State) -> bool) -> (Vec<State>, usize) {
    let mut index = HashMap::new();
    let mut states = Vec::new();
    let mut before: Vec<Vec<u32>> = Vec::new();
    for state in model.init_states() {
        index.insert(state.clone(), states.len());
        states.push(state);
        before.push(Vec::new());
    }
    let mut at = 0;
    while at < states.len() {
        for next in model.next_states(&states[at]) {
            let to = *index.entry(next).or_insert_with_key(|next| {
                states.push(next.clone());
                before.push(Vec::new());
                states.len() - 1
            });
            before[to].push(u32::try_from(at).expect("a model has fewer states"));
        }
        at += 1;
    }
    let mut ends: Vec<bool> = states.iter().map(good).collect();
    let mut todo: Vec<usize> = (0..states.len()).filter(|n| ends[*n]).collect();
    while let Some(n) = todo.pop() {
        for from in &before[n] {
            let from = *from as usize;
            if !ends[from] {
                ends[from] = true;
                todo.push(from);
            }
        }
    }
    let stranded = states
        .iter()
        .zip(&ends)
        .filter(|(_, ends)| !**ends)
        .map(|(state, _)| state.clone())
        .collect();
    (stranded, states.len())
}
