//! A process in a group that trains one network.

mod following;
mod leading;

use std::{
    io,
    net::TcpStream,
    sync::{
        Arc,
        mpsc::{Receiver, Sender, channel},
    },
    thread,
    time::{Duration, Instant},
};

use picofarm_model::{
    ModelError,
    train::{
        Line,
        group::{Compute, Group, Member, Next, Part},
    },
};
use tracing::{info, warn};

use crate::{
    Call, Rendezvous,
    endpoint::{Endpoint, visit},
    link::{Link, LinkEvent},
    mesh::{Breaker, Mesh},
    message::{Address, Message, Wish},
};
use leading::{Leads, Other};

/// Interval at which a waiting process checks whether to stop.
const ASK: Duration = Duration::from_millis(100);
/// Timeout for connecting all processes with one another.
const CONNECTED_WITHIN: Duration = Duration::from_secs(20);
/// Maximum number of processes.
const MOST: usize = 1024;

/// A process in a group that trains one network. Dropping it leaves the group.
pub struct Members<'a> {
    rendezvous: &'a dyn Rendezvous,
    stopped: &'a dyn Fn() -> bool,
    training: String,
    machine: String,
    endpoint: Endpoint,
    breaker: Arc<Breaker>,
    events: Receiver<(u64, LinkEvent)>,
    events_sender: Sender<(u64, LinkEvent)>,
    /// Connections for the all-reduce that arrived before this process knew of the agreement.
    early: Vec<(u64, usize, TcpStream)>,
    role: Role,
    mesh: Option<Mesh>,
    batches: usize,
    generation: u64,
    links: u64,
}

enum Role {
    /// Not in the group yet.
    None,
    Leads(Leads),
    Follows {
        link: Link,
        /// The last message of the leading process that was not handled yet.
        said: Option<(Message, Vec<u8>)>,
    },
}

/// The result of waiting for a message.
enum WaitResult {
    Message(Message, Vec<u8>),
    Lost,
    Stop,
}

fn failed(what: impl Into<String>) -> ModelError {
    ModelError::Group(what.into())
}

impl<'a> Members<'a> {
    /// Returns a process that listens at `host`, where others reach it, and takes part in the
    /// training with this key.
    ///
    /// # Errors
    /// [`ModelError::Group`] if it cannot listen there.
    pub fn new(
        rendezvous: &'a dyn Rendezvous,
        host: &str,
        training: &str,
        machine: &str,
        stopped: &'a dyn Fn() -> bool,
    ) -> Result<Self, ModelError> {
        let endpoint = Endpoint::open(host, training).map_err(|e| {
            failed(format!(
                "cannot listen at {host:?} for other processes of the training: {e}; give the worker an address of this \
                 machine"
            ))
        })?;
        let (events_sender, events) = channel();
        Ok(Self {
            rendezvous,
            stopped,
            training: training.to_owned(),
            machine: machine.to_owned(),
            endpoint,
            breaker: Arc::default(),
            events,
            events_sender,
            early: Vec::new(),
            role: Role::None,
            mesh: None,
            batches: 0,
            generation: 0,
            links: 0,
        })
    }

    /// Tells the others that the result is stored.
    pub fn announce_end(&mut self) {
        self.greet();
        if let Role::Leads(leads) = &mut self.role {
            for other in leads.others.iter().chain(&leads.coming) {
                other.link.say(&Message::Over, &[]);
            }
        }
    }

    /// Joins the leading process, or becomes it.
    fn find(&mut self) -> Result<(), ModelError> {
        self.mesh = None;
        self.breaker.break_off();
        loop {
            let newest = self.rendezvous.newest();
            let newest = newest.map_err(failed)?;
            let number = newest.as_ref().map_or(0, |(number, _)| *number);
            let own = self.endpoint.address().clone();
            if let Some((_, call)) = newest.filter(|(_, call)| call.secret != own.secret) {
                let to = Address {
                    address: call.address.clone(),
                    secret: call.secret,
                };
                match visit(&to, &self.training, Wish::Join(own.clone())) {
                    Ok(stream) => {
                        let link = self.link(stream).map_err(|e| failed(e.to_string()))?;
                        info!(
                            "trains together with the process at {} ({})",
                            call.address, call.machine
                        );
                        self.role = Role::Follows { link, said: None };
                        return Ok(());
                    }
                    Err(error) if call.machine != self.machine => {
                        warn!(
                            %error,
                            "the process that leads this training is at {} on {}, which does not answer; this one leads from \
                             now on. If that one lives, start workers with an address at which others reach them",
                            call.address, call.machine
                        );
                    }
                    Err(error) => {
                        info!(%error, "the process that led this training does not answer; this one leads from now on");
                    }
                }
            }
            if (self.stopped)() {
                return Ok(());
            }
            let call = Call {
                address: own.address,
                secret: own.secret,
                machine: self.machine.clone(),
            };
            // This must happen before the call is made, so that no process that reads the call is
            // rejected.
            self.endpoint.lead(true);
            if self.rendezvous.make(number + 1, &call).map_err(failed)? {
                self.role = Role::Leads(Leads::new(number + 1));
                return Ok(());
            }
            self.endpoint.lead(false);
        }
    }

    fn link(&mut self, stream: TcpStream) -> io::Result<Link> {
        self.links += 1;
        Link::open(
            self.links,
            stream,
            self.events_sender.clone(),
            self.breaker.clone(),
        )
    }

    /// Handles newly arrived connections.
    fn greet(&mut self) {
        while let Some(arrived) = self.endpoint.arrived() {
            match arrived.wish {
                Wish::Add { generation, rank } => {
                    self.early.push((generation, rank, arrived.stream));
                }
                Wish::Join(address) => {
                    let Ok(link) = self.link(arrived.stream) else {
                        continue;
                    };
                    // A dropped connection makes the process ask again.
                    if let Role::Leads(leads) = &mut self.role
                        && leads.others.len() + leads.coming.len() + 1 < MOST
                    {
                        leads.coming.push(Other::new(link, address));
                    }
                }
            }
        }
        self.early
            .retain(|(generation, ..)| *generation >= self.generation);
    }

    /// Connects with all other processes.
    fn connect(&mut self, rank: usize, all: &[Address]) -> io::Result<Mesh> {
        let generation = self.generation;
        let mut peers: Vec<Option<TcpStream>> = all.iter().map(|_| None).collect();
        for (peer, address) in all.iter().enumerate().take(rank) {
            let wish = Wish::Add { generation, rank };
            peers[peer] = Some(visit(address, &self.training, wish)?);
        }
        let begun = Instant::now();
        while peers.iter().flatten().count() + 1 < all.len() {
            self.greet();
            let mut left = Vec::new();
            for (of, from, stream) in self.early.drain(..) {
                match of == generation && from > rank && from < all.len() && peers[from].is_none() {
                    true => peers[from] = Some(stream),
                    false => left.push((of, from, stream)),
                }
            }
            self.early = left;
            if begun.elapsed() > CONNECTED_WITHIN || (self.stopped)() {
                return Err(io::ErrorKind::TimedOut.into());
            }
            if let Role::Follows { said: Some(_), .. } = &self.role {
                return Err(io::Error::other("another agreement"));
            }
            thread::sleep(Duration::from_millis(2));
        }
        Mesh::new(rank, peers, &self.breaker)
    }
}

impl Group for Members<'_> {
    fn agree(&mut self, member: &mut dyn Member) -> Result<Next, ModelError> {
        self.batches = member.batches();
        loop {
            if (self.stopped)() {
                return Ok(Next::Stop);
            }
            let next = match &self.role {
                Role::None => {
                    self.find()?;
                    None
                }
                Role::Leads(_) => self.gather(member)?,
                Role::Follows { .. } => self.follow(member)?,
            };
            if let Some(next) = next {
                return Ok(next);
            }
        }
    }

    fn go_on(&mut self) -> Result<bool, ModelError> {
        if (self.stopped)() {
            return Ok(false);
        }
        match &self.role {
            Role::None => Ok(false),
            Role::Follows { .. } => match self.next_message() {
                WaitResult::Message(Message::Go, _) => Ok(true),
                WaitResult::Message(message, payload) => {
                    self.put_back(message, payload);
                    Ok(false)
                }
                WaitResult::Lost | WaitResult::Stop => Ok(false),
            },
            Role::Leads(_) => Ok(self.lead_on()),
        }
    }

    fn is_alone(&self) -> bool {
        self.mesh.as_ref().is_none_or(|mesh| mesh.len() == 1)
    }

    fn sum(&mut self, step: u64, compute: Compute<'_>) -> Result<Option<Vec<Part>>, ModelError> {
        let Some(mesh) = &self.mesh else {
            return Ok(None);
        };
        let (computed, sums) = mesh.sums(step, self.batches, compute, &self.breaker, self.stopped);
        match (computed, sums) {
            (Ok(()), Ok(whole)) => Ok(Some(whole)),
            (computed, sums) => {
                self.mesh = None;
                self.breaker.break_off();
                if let Err(error) = sums
                    && computed.is_ok()
                    && !(self.stopped)()
                {
                    info!(%error, step, "a step is not added up; the processes of the training agree anew");
                }
                let generation = self.generation;
                match &mut self.role {
                    Role::Follows { link, .. } => {
                        link.say(&Message::Failed { generation }, &[]);
                    }
                    Role::Leads(leads) => leads.lost = true,
                    Role::None => {}
                }
                computed.map(|()| None)
            }
        }
    }

    fn tell(&mut self, line: &Line, digest: u64) {
        if let Role::Leads(leads) = &self.role {
            let message = Message::Epoch {
                line: *line,
                digest,
            };
            for other in &leads.others {
                other.link.say(&message, &[]);
            }
        }
    }

    fn hear(&mut self, digest: u64) -> Result<Option<Line>, ModelError> {
        match self.next_message() {
            WaitResult::Message(
                Message::Epoch {
                    line,
                    digest: theirs,
                },
                _,
            ) if theirs == digest => Ok(Some(line)),
            WaitResult::Message(Message::Epoch { .. }, _) => Err(failed(
                "after an epoch this process has other numbers than the one that leads; processes of one training must \
                 compute alike: give them the same kind of device and the same program",
            )),
            WaitResult::Message(message, payload) => {
                self.put_back(message, payload);
                Ok(None)
            }
            WaitResult::Lost | WaitResult::Stop => Ok(None),
        }
    }
}
