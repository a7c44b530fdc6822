use super::*;
use rand::{Rng, SeedableRng, rngs::SmallRng};

/// A graph of random costs, with about a fifth of its sides left open.
fn random_graph(seed: u64, nodes: u32) -> Graph {
    let mut rng = SmallRng::seed_from_u64(seed);
    let mut free: Vec<u32> = (0..3 * nodes).collect();
    let mut graph = Graph { twins: vec![NO_TWIN; 3 * nodes as usize], ..Graph::default() };
    while free.len() > 1 {
        let a = free.swap_remove(rng.random_range(0..free.len()));
        let b = free.swap_remove(rng.random_range(0..free.len()));
        if a / 3 != b / 3 && rng.random_bool(0.8) {
            (graph.twins[a as usize], graph.twins[b as usize]) = (b, a);
        }
    }
    graph.alone = (0..nodes).map(|_| rng.random_range(1.0..2.0)).collect();
    graph.pairs = vec![f32::INFINITY; graph.twins.len()];
    graph.strips = graph.pairs.clone();
    for side in 0..3 * nodes {
        let twin = graph.twins[side as usize];
        if twin != NO_TWIN && side < twin {
            let cost = rng.random_range(1.5..3.0);
            (graph.pairs[side as usize], graph.pairs[twin as usize]) = (cost, cost);
        }
        let [left, right] = others(side).map(|side| graph.twins[side as usize]);
        if left != NO_TWIN && right != NO_TWIN && left / 3 != right / 3 {
            graph.strips[side as usize] = rng.random_range(2.0..4.5);
        }
    }
    graph
}

/// The least that any division of the nodes that are left costs.
fn least(graph: &Graph, is_left: &mut Vec<bool>) -> f64 {
    let Some(node) = is_left.iter().position(|left| *left) else { return 0.0 };
    is_left[node] = false;
    let mut best = f64::from(graph.alone[node]) + least(graph, is_left);
    let mut consider = |others: &[usize], cost: f32| {
        if others.iter().all(|other| is_left[*other]) {
            others.iter().for_each(|other| is_left[*other] = false);
            best = best.min(f64::from(cost) + least(graph, is_left));
            others.iter().for_each(|other| is_left[*other] = true);
        }
    };
    let across = |side: u32| Some(graph.twins[side as usize]).filter(|twin| *twin != NO_TWIN);
    for side in 3 * node as u32..3 * node as u32 + 3 {
        let Some(twin) = across(side) else { continue };
        let other = twin / 3;
        consider(&[other as usize], graph.pairs[side as usize]);
        // Strips with the node as an end, and the other as the middle.
        for third in others(twin) {
            let omitted = 3 * other + (6 - third % 3 - twin % 3) % 3;
            let end = across(third).map(|end| end as usize / 3).filter(|end| *end != node);
            end.into_iter().for_each(|end| consider(&[other as usize, end], graph.strips[omitted as usize]));
        }
    }
    for side in 3 * node as u32..3 * node as u32 + 3 {
        if let [Some(left), Some(right)] = others(side).map(across)
            && left / 3 != right / 3
        {
            consider(&[left as usize / 3, right as usize / 3], graph.strips[side as usize]);
        }
    }
    is_left[node] = true;
    best
}

fn divide(graph: &Graph) -> Joined {
    graph.divide(&Cancel::default()).expect("nobody asks to end")
}

#[test]
fn random_graphs_cost_little_more_than_the_least() {
    let (mut found, mut possible, mut exact) = (0.0, 0.0, 0);
    for seed in 0..60 {
        let graph = random_graph(seed, 10);
        let (cost, best) = (graph.cost(&divide(&graph)), least(&graph, &mut vec![true; 10]));
        assert!(cost >= best - 1e-4, "seed {seed}: {cost} is less than anything can cost, {best}");
        (found, possible) = (found + cost, possible + best);
        exact += u32::from(cost <= best + 1e-4);
    }
    assert!(found <= 1.04 * possible && exact >= 25, "{found} of {possible}, {exact} of 60 exactly");
}

#[test]
fn a_chain_is_divided_as_cheaply_as_can_be_by_one_tree() {
    let mut graph = random_graph(7, 12);
    graph.twins.fill(NO_TWIN);
    for node in 0..11u32 {
        let (a, b) = (3 * node + 1, 3 * (node + 1));
        (graph.twins[a as usize], graph.twins[b as usize]) = (b, a);
        let cost = 1.6 + 0.2 * (node % 5) as f32;
        (graph.pairs[a as usize], graph.pairs[b as usize]) = (cost, cost);
    }
    graph.strips = (0..36)
        .map(|side| if side % 3 == 2 && (5..33).contains(&side) { 2.4 } else { f32::INFINITY })
        .collect();
    let mut joined = vec![false; 36];
    let sides: Vec<u32> = (0..11).map(|node| 3 * node + 1).collect();
    Tree::through(&graph, &joined.clone(), &sides).divide(&mut joined);
    let best = least(&graph, &mut vec![true; 12]);
    assert!((graph.cost(&joined) - best).abs() < 1e-4, "{} is not {best}", graph.cost(&joined));
}

#[test]
fn no_round_makes_a_division_worse() {
    let graph = random_graph(11, 400);
    let mut sides: Vec<u32> = (0..1200).filter(|side| graph.twins[*side as usize] != NO_TWIN).collect();
    let (mut joined, mut order, mut before) = (vec![false; 1200], Order(3), f64::INFINITY);
    for _ in 0..10 {
        order.shuffle(&mut sides);
        Tree::through(&graph, &joined.clone(), &sides).divide(&mut joined);
        let cost = graph.cost(&joined);
        assert!(cost <= before + 1e-3, "{cost} after {before}");
        before = cost;
    }
}

#[test]
fn whoever_asks_to_end_is_heard() {
    let cancel = Cancel::default();
    cancel.ask();
    assert_eq!(random_graph(1, 4).divide(&cancel), Err(Cancelled));
}
